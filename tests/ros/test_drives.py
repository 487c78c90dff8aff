"""What leaves the controller's node: no jump after a stall, and the modes that the in-process loop has too."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.types import Array
from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

import pinocchio as pin
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from tests.ros.cell import PATIENT, Cell, Stream, changed_cell, shifted, start_controller, start_robot
from tests.ros.waiting import wait_until

pytestmark = pytest.mark.alone

RATE = 125.0  # of the control loop [Hz]
PLACES = (-0.05, 0.2)  # above home, between which the arm becomes fast [m]
COMMANDS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST)
ADMITTANCE = {"enabled": True, "stiffness": 500.0, "force_dead_band": 0.0}
HANGS = 0.13  # longer than commands may go without an acknowledgement, and too short to ask a robot to jump [s]
SAG = 0.03  # a command that begins anew is no farther from what was measured [rad]


class Commanded(NamedTuple):
    """One command: its number at the publisher, where the joints were measured then, and where they have to be."""

    number: int
    measured: Array
    q: Array
    t: float  # of its receipt [s]


class Recorder:
    """Takes every command of a controller."""

    def __init__(self, cell: Cell, robot: Robot) -> None:
        self.commands: list[Commanded] = []
        self._cell, self._names = cell, robot.joint_names
        cell.node.create_subscription(JointTrajectory, "/joint_trajectory", self._take, COMMANDS)

    def _take(self, message: JointTrajectory, info: Mapping[str, Any]) -> None:
        place = {name: index for index, name in enumerate(message.joint_names)}
        q = np.array([message.points[0].positions[place[name]] for name in self._names])
        measured = self._cell.q if self._cell.postures else q
        self.commands.append(Commanded(info["publication_sequence_number"], measured, q, time.monotonic()))


@pytest.mark.slow
@pytest.mark.parametrize("stall", [0.02, 0.05, 0.1])
def test_a_controller_that_is_stopped_for_a_while_publishes_no_jump(
    stall: float, robot: Robot, processes: Processes, node: Any
) -> None:
    cell, controller, recorder, stream = recorded(robot, processes, node)
    home = stream.poses["left"]
    try:
        for _ in range(4):
            begin = len(recorder.commands)
            # The farther one, since a stall that starts over leaves the arm anywhere in between.
            height = cell.tool("left").translation[2]
            goal = max(PLACES, key=lambda place: abs(home.translation[2] + place - height))
            stream.poses["left"] = shifted(home, 0.0, 0.0, goal)
            wait_until(partial(moves_fast, recorder, begin), "the arm moves fast", lambda: cell.states)
            os.kill(controller.pid, signal.SIGSTOP)
            time.sleep(stall)
            os.kill(controller.pid, signal.SIGCONT)
            time.sleep(0.7)
            if cell.state("left_state") != "following":  # a longer stall starts over
                stream.end()
                cell.wait_until_active()
                time.sleep(0.6)
                stream = cell.engage("left")
    finally:
        stream.end()
    assert_no_jump(recorder.commands, robot)


def test_no_jump_is_published_while_a_robot_that_hangs_as_a_motion_begins_acknowledges_nothing(
    robot: Robot, processes: Processes, node: Any
) -> None:
    cell, _, recorder, stream = recorded(robot, processes, node)
    simulation = cell.processes[0]
    try:
        for times in range(4):
            begin = len(recorder.commands)
            stream.poses["left"] = shifted(stream.poses["left"], 0.0, 0.0, 0.15 if times % 2 == 0 else -0.15)
            wait_until(partial(moves, recorder, begin), "the reference moves")
            os.kill(simulation.pid, signal.SIGSTOP)
            time.sleep(HANGS)
            os.kill(simulation.pid, signal.SIGCONT)
            time.sleep(1.5)
    finally:
        os.kill(simulation.pid, signal.SIGCONT)
        stream.end()
    assert_no_jump(recorder.commands, robot)


def recorded(robot: Robot, processes: Processes, node: Any) -> tuple[Cell, RosProcess, Recorder, Stream]:
    """A cell whose left arm follows a stream, its controller, and what records every command."""
    cell = Cell(node, robot, start_robot(processes))
    controller = start_controller(processes, *PATIENT, f"rate:={RATE}")
    cell.wait_until_active()
    return cell, controller, Recorder(cell, robot), cell.engage("left")


def assert_no_jump(commands: list[Commanded], robot: Robot) -> None:
    """No command asks a joint for more than it may do in the periods since the one before."""
    limit = robot.velocity_limit / RATE
    for before, after in pairwise(commands):
        way = np.abs(after.q - before.q)
        periods = after.number - before.number
        # A gap of more than 100 ms, which a busy machine may make of any stall: the controller starts over at the arms.
        anew = np.abs(after.q - after.measured).max() < SAG and after.t - before.t > 0.1
        assert (way <= periods * limit * (1.0 + 1e-6)).all() or anew, (way / limit).max() / periods


def moves(recorder: Recorder, begin: int) -> bool:
    """Whether commands from index ``begin`` on have begun to move."""
    return fastest(recorder.commands[begin:]) > 0.05


def moves_fast(recorder: Recorder, begin: int) -> bool:
    """Whether commands from index ``begin`` on have become fast."""
    return fastest(recorder.commands[begin:]) > 0.7


def fastest(commands: list[Commanded]) -> float:
    """Largest speed of a joint between two commands [rad/s]."""
    speeds = (
        float(np.abs(after.q - before.q).max() / max(after.number - before.number, 1) * RATE)
        for before, after in pairwise(commands)
    )
    return max(speeds, default=0.0)


def test_in_velocity_mode_the_arm_follows_and_stays_where_it_was_left(
    robot: Robot, processes: Processes, node: Any
) -> None:
    cell = Cell(node, robot, start_robot(processes))
    start_controller(processes, *PATIENT, "output:=velocity")
    cell.wait_until_active()
    stream = cell.engage("left")
    begin = stream.poses["left"]
    stream.move("left", (0.0, 0.0, 0.1))
    wait_until(lambda: off(cell, "left", shifted(begin, 0.0, 0.0, 0.1)) < 4e-3, "the arm is there")
    stream.end()
    wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
    rest = cell.q
    assert cell.call("/cartesian_controller/stop").success
    time.sleep(1.0)
    assert np.abs(cell.q - rest).max() < 5e-3


def off(cell: Cell, arm: str, pose: pin.SE3) -> float:
    """Distance of an arm's tool from a pose [m]."""
    return float(np.linalg.norm(cell.tool(arm).translation - pose.translation))


def test_with_the_admittance_a_measured_force_displaces_the_target_and_without_its_topic_the_node_ends(
    robot: Robot, processes: Processes, node: Any, tmp_path: Path
) -> None:
    config = f"config:={changed_cell(tmp_path, admittance=ADMITTANCE)}"
    refused = start_controller(processes, config)
    assert refused.wait() == 2
    assert "admittance.enabled = true: set the parameter external_torque_topic" in refused.output
    torques = node.create_publisher(JointState, "/felt", 10)
    force = np.zeros(3)

    def publish() -> None:
        frame = robot.arms["left"].frame_id
        data = robot.model.createData()
        q = cell.q if cell.postures else robot.home
        J = pin.computeFrameJacobian(robot.model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        torques.publish(JointState(name=list(robot.joint_names), effort=(J[:3].T @ force).tolist()))

    cell = Cell(node, robot, start_robot(processes))
    timer = node.create_timer(0.01, publish)
    start_controller(processes, *PATIENT, config, "external_torque_topic:=/felt")
    cell.wait_until_active()
    stream = cell.engage("left")
    begin = stream.poses["left"]
    force[2] = 20.0
    pushed = shifted(begin, 0.0, 0.0, 20.0 / 500.0)
    wait_until(lambda: off(cell, "left", pushed) < 6e-3, "the tool yields by force over stiffness")
    force[2] = 0.0
    wait_until(lambda: off(cell, "left", begin) < 6e-3, "the tool is back")
    stream.end()
    node.destroy_timer(timer)
