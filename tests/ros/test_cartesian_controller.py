"""The controller as a process that moves the simulated robot: targets followed, faults survived, nothing jumps."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import Processes

need_ros()

import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.ros.bridge.messages import pose_message, stamped_pose, time_message
from tests.ros.cell import NODE_RATE, PATIENT, STILL, Cell, Stream, shifted, start_controller, start_robot
from tests.ros.processes import wait_until

pytestmark = pytest.mark.alone


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cell:
    started = start_robot(module_processes), start_controller(module_processes, *PATIENT)
    return Cell(module_node, robot, *started)


@pytest.fixture
def cell(started: Cell) -> Iterator[Cell]:
    """At home, active, without targets."""
    started.stop_and_reset(at_home=True)
    started.wait_until_active()
    started.forget()
    yield started
    started.end_streams()


def test_an_arm_follows_its_target_and_the_other_one_holds(cell: Cell, robot: Robot) -> None:
    stream = cell.engage("left")
    start_q, begin = cell.q, stream.poses["left"]
    stream.move("left", (0.05, 0.0, 0.0))
    goal = stream.poses["left"]
    assert np.linalg.norm(goal.translation - begin.translation) == pytest.approx(0.05)
    cell.wait_until_there("left", goal, 2e-3)
    wait_until(lambda: np.linalg.norm(pin.log3(cell.tool("left").rotation.T @ goal.rotation)) < 5e-3, "it is turned so")
    right = robot.arms["right"].joints
    assert all(np.abs((q - start_q)[right]).max() < STILL for q in cell.postures)


def test_a_bad_target_moves_nothing_and_is_reported_once(cell: Cell) -> None:
    wait_until(lambda: cell.state("level") == "ok", "nothing is wrong")
    before, begin, process = cell.q, len(cell.processes[1].output), cell.processes[1]
    far, odd = shifted(cell.tool("left"), 0.1, 0.0, 0.0), PoseStamped(pose=pose_message(cell.tool("left")))
    odd.header.frame_id = "elsewhere"
    kinds = {"frame_id 'elsewhere'": odd, "the stream is 0.1": stamped_pose(far, "world", 0.0)}
    for said, message in kinds.items():
        for _ in range(30):
            cell.send("left", message)
            time.sleep(0.01)
        process.wait_for(said)
        assert process.output[begin:].count(said) == 1
    wait_until(lambda: cell.state("level") == "warn", "it is in the diagnostics")
    assert "target of left not used" in cell.state("message")
    assert all(np.abs(q - before).max() < STILL for q in cell.postures)


def test_an_arm_holds_without_targets_and_follows_only_a_stream_that_begins_at_its_tool(cell: Cell) -> None:
    stream = cell.engage("left")
    stream.move("left", (0.05, 0.0, 0.0))
    stream.end()
    wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
    rest = cell.joints.wait_for_rest()
    far = shifted(stream.poses["left"], 0.0, 0.0, 0.1)
    again = Stream(cell, {"left": far})
    again.move("left", (0.0, 0.0, -0.1))  # comes by where the arm is
    time.sleep(0.3)
    assert np.abs(cell.q - rest).max() < STILL
    assert cell.state("left_state") == "holding"
    again.poses["left"] = far
    time.sleep(0.1)
    again.poses["left"] = cell.tool("left")  # engaged again, without a gap in the targets
    wait_until(lambda: cell.state("left_state") == "following", "the arm follows")


def test_pause_stop_and_home(cell: Cell, robot: Robot) -> None:
    stream = cell.engage("left")
    stream.move("left", (0.0, 0.0, 0.06))
    assert cell.call("/cartesian_controller/pause", SetBool.Request(data=True)).success
    rest = cell.joints.wait_for_rest()
    stream.move("left", (0.05, 0.0, 0.0))
    assert np.abs(cell.q - rest).max() < STILL
    assert not cell.call("/cartesian_controller/home").success
    assert cell.call("/cartesian_controller/pause", SetBool.Request(data=False)).success
    assert cell.call("/cartesian_controller/home").success
    cell.wait_until_there("left", robot.tool_pose(robot.home, "left"), 4e-3)
    assert cell.call("/cartesian_controller/stop").success
    wait_until(lambda: cell.state("phase") == "stopped", "the controller is stopped")
    wait_until(lambda: cell.state("mode", "mujoco_robot") == "holding", "nothing is commanded")


def test_a_controller_that_stood_still_in_motion_publishes_no_jump(cell: Cell, robot: Robot) -> None:
    commands: list[tuple[int, Any]] = []  # their numbers, and the positions

    def take(message: JointTrajectory, info: Any) -> None:
        order = [message.joint_names.index(name) for name in robot.joint_names]
        commands.append((info["publication_sequence_number"], np.array(message.points[0].positions)[order]))

    subscription = cell.node.create_subscription(JointTrajectory, "/joint_trajectory", take, 1000)
    stream = cell.engage("left")
    for way in (0.2, -0.2, 0.2):
        stream.poses["left"] = shifted(stream.poses["left"], 0.0, 0.0, way)
        wait_until(lambda: cell.joints.speeds(0.05).max() > 0.5, "the arm is fast")
        os.kill(cell.processes[1].pid, signal.SIGSTOP)
        time.sleep(0.05)  # less than what would start over
        os.kill(cell.processes[1].pid, signal.SIGCONT)
        time.sleep(0.7)
    for (before, start), (number, end) in pairwise(commands):
        assert (np.abs(end - start) <= (number - before) * robot.velocity_limit / NODE_RATE * (1.0 + 1e-6)).all()
    cell.node.destroy_subscription(subscription)


def test_invalid_joint_states_stop_the_arms_with_one_diagnostic(cell: Cell, robot: Robot) -> None:
    process, said = cell.processes[1], "joint states: position of left_A4 is not finite"
    begin = len(process.output)
    stream = cell.engage("left")
    stream.move("left", (0.0, 0.0, 0.03))
    publisher = cell.node.create_publisher(JointState, "/joint_states", 10)
    q = cell.q.copy()
    q[robot.joint_names.index("left_A4")] = math.nan
    message = JointState(name=list(robot.joint_names), position=q.tolist())
    wait_until(lambda: publisher.publish(message) or said in process.output[begin:], "it is reported")
    cell.node.destroy_publisher(publisher)
    wait_until(lambda: "active: " in process.output[begin:], "the controller is active again")
    stream.move("left", (0.05, 0.0, 0.0))
    assert process.output[begin:].count(said) == 1
    wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
    rest = cell.joints.wait_for_rest()
    time.sleep(0.3)
    assert np.abs(cell.q - rest).max() < STILL


def test_a_second_publisher_of_targets_in_mid_motion_stops_the_arm_and_is_named(cell: Cell, domain: int) -> None:
    stream = cell.engage("left")
    begin, elsewhere = stream.poses["left"], shifted(cell.tool("left"), 0.0, 0.0, 0.2)
    with spun_node(domain, "sender") as other:
        publisher = other.create_publisher(PoseStamped, "/q2r2/left/target_frame", COMMAND_QOS)
        timer = other.create_timer(0.01, lambda: publisher.publish(stamped_pose(elsewhere, "world", 0.0)))

        def named() -> bool:
            stream.move("left", (0.0, 0.01, 0.0), speed=0.1)
            stream.move("left", (0.0, -0.01, 0.0), speed=0.1)
            return "two publishers at a time from /sender and /test; allowed: one" in str(cell.state("message"))

        wait_until(named, "both are named", lambda: cell.state("message"))
        wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
        rest = cell.joints.wait_for_rest()
        time.sleep(0.5)
        assert np.abs(cell.q - rest).max() < STILL
        other.destroy_timer(timer)
    tools = [cell.robot.tool_pose(q, "left").translation for q in cell.postures]
    assert max(np.linalg.norm(tool - begin.translation) for tool in tools) < 0.03  # nothing but its own 1 cm
    stream.poses["left"] = shifted(begin, 0.0, 0.0, 0.2)
    time.sleep(1.5)  # longer than two publishers count
    stream.poses["left"] = cell.tool("left")
    wait_until(lambda: cell.state("left_state") == "following", "the stream that is left begins anew")


def test_it_follows_in_another_layout_and_frame_and_on_simulated_time(
    cell: Cell, robot: Robot, processes: Processes
) -> None:
    cell.call("/cartesian_controller/stop")
    layout = ("left.target_topic:=/left/target_pose", "left.target_frame_id:=left_link_0", "output:=joint_state")
    start_controller(processes, *layout, *PATIENT, "use_sim_time:=true", node="second")
    states: list[dict[str, Any]] = []
    node = cell.node
    subscription = node.create_subscription(String, "/second/state", lambda m: states.append(json.loads(m.data)), 10)
    clock = node.create_publisher(Clock, "/clock", 10)
    targets = node.create_publisher(PoseStamped, "/left/target_pose", COMMAND_QOS)
    wait_until(lambda: states and "nothing comes on /clock" in states[-1]["message"], "the missing clock is reported")
    began = time.monotonic()
    timer = node.create_timer(0.005, lambda: clock.publish(Clock(clock=time_message(100 + time.monotonic() - began))))
    wait_until(lambda: states and states[-1]["phase"] == "active", "the second controller is active")
    base = robot.model.frames[robot.model.getFrameId("left_link_0")].placement
    tool = cell.tool("left")
    for step in range(51):
        goal = base.actInv(shifted(tool, 0.0, 0.001 * step, 0.0))
        targets.publish(stamped_pose(goal, "left_link_0", 0.0))
        time.sleep(0.02)
    wait_until(lambda: abs(cell.tool("left").translation[1] - tool.translation[1] - 0.05) < 4e-3, "the arm is there")
    node.destroy_timer(timer)
    for publisher in (clock, targets):
        node.destroy_publisher(publisher)
    node.destroy_subscription(subscription)
