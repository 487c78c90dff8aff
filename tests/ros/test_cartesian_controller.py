"""The controller as a process that moves the simulated robot: it follows targets, survives faults, and never jumps."""

from __future__ import annotations

import json
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
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.ros.bridge.messages import stamped_pose, time_message
from tests.ros.cell import NODE_RATE, PATIENT, STILL, Cell, shifted, start_controller, start_robot
from tests.ros.processes import wait_until

pytestmark = pytest.mark.alone


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cell:
    started = start_robot(module_processes), start_controller(module_processes, *PATIENT)
    return Cell(module_node, robot, *started)


@pytest.fixture
def cell(started: Cell) -> Iterator[Cell]:
    """Return a cell at home that is active and has no targets."""
    started.stop_and_reset(at_home=True)
    started.wait_until_active()
    started.forget()
    yield started
    started.end_streams()


def test_an_arm_follows_its_target_while_the_other_arm_holds(cell: Cell, robot: Robot) -> None:
    assert "[INFO]" in cell.processes[1].wait_for("active: the reference"), "nothing is wrong with that"
    assert "[WARN]" in cell.processes[1].wait_for("the stop service was called")
    stream = cell.engage("left")
    start_q, begin = cell.q, stream.poses["left"]
    stream.move("left", (0.05, 0.0, 0.0))
    goal = stream.poses["left"]
    assert np.linalg.norm(goal.translation - begin.translation) == pytest.approx(0.05)
    cell.wait_until_there("left", goal, 2e-3)
    wait_until(lambda: np.linalg.norm(pin.log3(cell.tool("left").rotation.T @ goal.rotation)) < 5e-3, "it is turned so")
    right = robot.arms["right"].joints
    assert all(np.abs((q - start_q)[right]).max() < STILL for q in cell.postures)


def test_the_services_pause_and_stop_bring_the_arms_to_rest_and_the_service_home_moves_them_home(
    cell: Cell, robot: Robot
) -> None:
    stream, requests = cell.engage("left"), cell.state("requests")
    stream.move("left", (0.0, 0.0, 0.06))
    assert cell.call("/cartesian_controller/pause", SetBool.Request(data=True)).success
    rest = cell.joints.wait_for_rest()
    stream.move("left", (0.05, 0.0, 0.0))
    assert np.abs(cell.q - rest).max() < STILL
    assert not cell.call("/cartesian_controller/home").success
    assert cell.call("/cartesian_controller/pause", SetBool.Request(data=False)).success
    assert cell.call("/cartesian_controller/home").success
    cell.wait_until_there("left", robot.tool_pose(robot.home, "left"), 4e-3)
    wait_until(lambda: cell.state("homing_outcome") == {"kind": "homing_arrived"}, "the way home has ended")
    assert cell.state("fault") is None
    assert cell.state("requests") == requests + 4, "scripted hands see by this number that they may press no more"
    assert cell.call("/cartesian_controller/stop").success
    wait_until(lambda: cell.state("phase") == "stopped", "the controller is stopped")
    assert (cell.state("fault"), cell.state("kind")) == ({"kind": "stop_service"}, "stop_service")
    wait_until(lambda: cell.state("mode", "mujoco_robot") == "holding", "nothing is commanded")


def test_a_controller_that_stood_still_during_a_motion_publishes_no_jump(cell: Cell, robot: Robot) -> None:
    commands: list[tuple[int, Any]] = []  # Numbers and positions of the commands.

    def take(message: JointTrajectory, info: Any) -> None:
        order = [message.joint_names.index(name) for name in robot.joint_names]
        commands.append((info["publication_sequence_number"], np.array(message.points[0].positions)[order]))

    subscription = cell.node.create_subscription(JointTrajectory, "/joint_trajectory", take, 1000)
    stream = cell.engage("left")
    for way in (0.2, -0.2, 0.2):
        stream.poses["left"] = shifted(stream.poses["left"], 0.0, 0.0, way)
        wait_until(lambda: cell.joints.speeds(0.05).max() > 0.5, "the arm is fast")
        os.kill(cell.processes[1].pid, signal.SIGSTOP)
        time.sleep(0.05)  # After so short a standstill, the controller does not start anew.
        os.kill(cell.processes[1].pid, signal.SIGCONT)
        time.sleep(0.7)
    for (before, start), (number, end) in pairwise(commands):
        assert (np.abs(end - start) <= (number - before) * robot.velocity_limit / NODE_RATE * (1.0 + 1e-6)).all()
    cell.node.destroy_subscription(subscription)


def test_a_second_publisher_of_targets_during_motion_stops_the_arm_and_is_named(cell: Cell, domain: int) -> None:
    stream = cell.engage("left")
    begin, elsewhere = stream.poses["left"], shifted(cell.tool("left"), 0.0, 0.0, 0.2)
    both = "/sender and /test"
    with spun_node(domain, "sender") as other:
        publisher = other.create_publisher(PoseStamped, "/q2r2/left/target_frame", COMMAND_QOS)
        timer = other.create_timer(0.01, lambda: publisher.publish(stamped_pose(elsewhere, "world", 0.0)))

        def named() -> bool:
            stream.move("left", (0.0, 0.01, 0.0), speed=0.1)
            stream.move("left", (0.0, -0.01, 0.0), speed=0.1)
            refusal = cell.state("left_target_refusal") or {"kind": None}
            return bool(refusal["kind"] == "two_publishers" and refusal["detail"]["source"].endswith(both))

        wait_until(named, "both are named", lambda: cell.state("message"))
        wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
        rest = cell.joints.wait_for_rest()
        time.sleep(0.5)
        assert np.abs(cell.q - rest).max() < STILL
        other.destroy_timer(timer)
    tools = [cell.robot.tool_pose(q, "left").translation for q in cell.postures]
    # The arm may only follow the motion of 1 cm of its first stream.
    assert max(np.linalg.norm(tool - begin.translation) for tool in tools) < 0.03
    stream.poses["left"] = shifted(begin, 0.0, 0.0, 0.2)
    time.sleep(1.5)  # After this time, the controller again counts only one publisher.
    stream.poses["left"] = cell.tool("left")
    wait_until(lambda: cell.state("left_state") == "following", "the stream that is left begins anew")


def test_the_controller_follows_targets_on_another_topic_in_another_frame_and_in_simulated_time(
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
    wait_until(lambda: states and "clock_problem" in states[-1], "the missing clock is reported")
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
