"""Layouts and kinds of command: a namespace an arm, torques, an LBR's messages; each moves the simulated robot."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot, load_config
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import CONFIG, Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

import pinocchio as pin
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.types import Array
from tests.ros.cell import PATIENT, SOFT, STILL, Cell, Stream, changed_cell, start_controller, start_robot
from tests.ros.waiting import wait_until

pytestmark = pytest.mark.alone

Engage = Callable[..., Stream]
TARGETS = "/{arm}/target_pose"
TARGET_TOPICS = [f"{arm}.target_topic:=/{arm}/target_pose" for arm in ("left", "right")]


@pytest.fixture(scope="module")
def started(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """One simulated robot for all tests; each brings a controller of its own."""
    processes = Processes(tmp_path_factory.mktemp("cell"), os.environ)
    with spun_node(domain) as node:
        yield Cell(node, robot, start_robot(processes), targets=TARGETS)
        processes.end_all()


@pytest.fixture
def cell(started: Cell) -> Cell:
    """At home, without commands."""
    wait_until(lambda: started.state("mode", "mujoco_robot") == "holding", "the robot holds")
    started.call("/mujoco_robot/reset")
    started.states.pop("cartesian_controller", None)
    started.wait_until_home()
    started.forget()
    return started


@pytest.fixture
def engage(cell: Cell) -> Iterator[Engage]:
    """Begins streams of targets at tools, which end with the test."""
    streams: list[Stream] = []

    def begin(*arms: str) -> Stream:
        streams.append(cell.engage(*arms))
        return streams[-1]

    yield begin
    for stream in streams:
        stream.end()


def away(cell: Cell, stream: Stream) -> float:
    """How far the tools are from their targets at most [m]."""
    return max(
        float(np.linalg.norm(cell.tool(arm).translation - goal.translation)) for arm, goal in stream.poses.items()
    )


class Relay:
    """Between a robot that knows one topic of all arms, and a controller with a namespace an arm."""

    def __init__(self, node: Any, robot: Robot) -> None:
        self._node, self.silent, self.lost = node, "", ""  # the arm whose joint states it keeps back, and the joint
        self.commanded: dict[str, set[tuple[str, ...]]] = {arm: set() for arm in robot.arms}
        self._states = {arm: node.create_publisher(JointState, f"/{arm}/joint_states", 10) for arm in robot.arms}
        self._commands = node.create_publisher(JointTrajectory, "/joint_trajectory", COMMAND_QOS)
        self._subscriptions = [node.create_subscription(JointState, "/joint_states", self._split, 10)]
        for arm in robot.arms:
            topic = f"/{arm}/arm_controller/joint_trajectory"
            listener = node.create_subscription(JointTrajectory, topic, partial(self._join, arm), 10)
            self._subscriptions.append(listener)

    def _split(self, message: JointState) -> None:
        for arm, publisher in self._states.items():
            columns = [i for i, name in enumerate(message.name) if name.startswith(arm) and name != self.lost]
            columns.reverse()
            if arm != self.silent:
                part = JointState(
                    name=[message.name[i] for i in columns],
                    position=[message.position[i] for i in columns],
                    velocity=[message.velocity[i] for i in columns],
                )
                publisher.publish(part)

    def _join(self, arm: str, message: JointTrajectory) -> None:
        self.commanded[arm].add(tuple(message.joint_names))
        self._commands.publish(message)

    def end(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in (*self._states.values(), self._commands):
            self._node.destroy_publisher(publisher)


@pytest.fixture
def relay(cell: Cell, robot: Robot) -> Iterator[Relay]:
    made = Relay(cell.node, robot)
    yield made
    made.end()


def test_a_namespace_an_arm_is_merged_by_name_and_commanded_apart(
    cell: Cell, robot: Robot, relay: Relay, processes: Processes, engage: Engage
) -> None:
    layout = [f"{arm}.joint_states_topic:=/{arm}/joint_states" for arm in robot.arms]
    # Its right arm is named by the pattern for all, its left one by itself.
    layout += ["output_topic:=/{arm}/arm_controller/joint_trajectory"]
    layout += ["left.output_topic:=/left/arm_controller/joint_trajectory"]
    start_controller(processes, *TARGET_TOPICS, *layout, *PATIENT)
    cell.wait_until_active()
    stream = engage("left", "right")
    begin = cell.q
    stream.move("left", (0.0, 0.0, 0.05))
    stream.move("right", (0.05, 0.0, 0.0))
    wait_until(lambda: away(cell, stream) < 3e-3, "both arms are there")
    assert np.abs(cell.q - begin).max() > 0.05
    joints = {arm: tuple(name for name in robot.joint_names if name.startswith(arm)) for arm in robot.arms}
    assert relay.commanded == {arm: {names} for arm, names in joints.items()}

    relay.silent = "right"
    wait_until(lambda: cell.state("level") == "error", "the stall is reported")
    assert "no joint states from /test on /right/joint_states for 0." in cell.state("message")
    relay.silent = ""
    wait_until(lambda: cell.state("phase") == "active", "the controller is active again")
    relay.lost = "right_A3"
    wait_until(lambda: "/right/joint_states: no joint right_A3" in cell.state("message"), "the lost joint is reported")
    relay.lost = ""
    wait_until(lambda: cell.state("phase") == "active", "the controller is active again")


def test_torques_move_an_arm_and_leave_it_on_its_servos_when_the_controller_is_killed(
    cell: Cell, processes: Processes, engage: Engage, tmp_path: Path
) -> None:
    soft = f"config:={changed_cell(tmp_path, impedance=SOFT)}"
    controller = start_controller(processes, *TARGET_TOPICS, "output:=torque", *PATIENT, soft)
    cell.wait_until_active()
    wait_until(lambda: cell.state("mode", "mujoco_robot") == "torque", "the robot is driven by torques")
    stream = engage("left")
    stream.move("left", (0.0, 0.0, 0.05), speed=0.1)
    wait_until(lambda: away(cell, stream) < 3e-3, "the arm is there")
    before = cell.joints.wait_for_rest()
    assert away(cell, stream) < 3e-3
    assert cell.state("mode", "mujoco_robot") == "torque"
    cell.forget()
    os.kill(controller.pid, signal.SIGKILL)
    stream.end()
    wait_until(lambda: cell.state("mode", "mujoco_robot") == "holding", "the robot holds")
    time.sleep(0.5)
    assert max(np.abs(q - before).max() for q in cell.postures) < STILL


def lbr_commands(listener: RosProcess, arm: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All that an arm's driver was sent so far: positions (n, 7), torques (n, 7) and times (n,) [s]."""
    lines = [json.loads(line) for line in listener.output.splitlines()[1:-1]]
    its = [line for line in lines if line["arm"] == arm]
    q, tau, t = (np.array([line[field] for line in its], float) for field in ("q", "tau", "t"))
    return q, tau, t * 1e-9


def start_lbr(
    cell: Cell, processes: Processes, environment: dict[str, str], output: str, message: str
) -> tuple[RosProcess, Array]:
    """Start drivers and a controller; the drivers, and the joint positions before."""
    listener = processes.start_module("tests.ros.programs.lbr_driver", message, "left", "right", **environment)
    listener.wait_for("listens")
    before = cell.q
    given = (*TARGET_TOPICS, f"output:={output}", "max_deviation:=3.0", *PATIENT)
    start_controller(processes, *given, **environment)
    cell.wait_until_active()
    wait_until(lambda: all(len(lbr_commands(listener, arm)[0]) for arm in ("left", "right")), "commands come")
    return listener, before


def test_positions_for_an_lbr_begin_where_it_is_and_step_no_further_than_its_joints_may(
    cell: Cell, robot: Robot, processes: Processes, engage: Engage, other_interfaces: dict[str, str]
) -> None:
    listener, before = start_lbr(cell, processes, other_interfaces, "lbr_position", "LBRJointPositionCommand")
    # Found late, the driver would ask the robot for a jump.
    wait_until(lambda: cell.state("mode", "mujoco_robot") == "position", "the robot is commanded")
    stream = engage("left")
    stream.move("left", (0.0, 0.0, 0.05))
    wait_until(lambda: away(cell, stream) < 3e-3, "the arm is there")
    for arm in ("left", "right"):
        joints = robot.arms[arm].joints
        q, _, t = lbr_commands(listener, arm)
        assert np.abs(q[0] - before[joints]).max() < 1e-5
        # The tick's own length is what the step may use; it shows in the times up to what the messages are late.
        longest = robot.velocity_limit[joints] * (np.diff(t)[:, None] + 0.02)
        assert (np.abs(np.diff(q, axis=0)) <= longest).all()


def test_torques_for_an_lbr_are_without_gravity_and_come_with_its_measured_positions(
    cell: Cell, robot: Robot, processes: Processes, engage: Engage, other_interfaces: dict[str, str]
) -> None:
    listener, before = start_lbr(cell, processes, other_interfaces, "lbr_torque", "LBRTorqueCommand")
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), before)
    for arm in ("left", "right"):
        joints = robot.arms[arm].joints
        assert np.abs(gravity[joints]).max() > 20.0
        q, tau, _ = lbr_commands(listener, arm)
        assert np.abs(tau[0]).max() < 0.5
        assert np.abs(q[0] - before[joints]).max() < 1e-5
    stream = engage("left")
    stream.move("left", (0.0, 0.0, 0.02))
    # The simulated arm stays where it is, so the torque is that of a spring stretched by 20 mm: F = J^-T tau.
    data = robot.model.createData()
    J = pin.computeFrameJacobian(robot.model, data, before, robot.arms["left"].frame_id, pin.LOCAL_WORLD_ALIGNED)
    to_force = np.linalg.pinv(J[:, robot.arms["left"].joints].T)
    wanted = load_config(CONFIG).impedance.translational_stiffness * 0.02

    def force() -> float:
        return float((to_force @ lbr_commands(listener, "left")[1][-1])[2])

    wait_until(lambda: abs(force() - wanted) < 0.05 * wanted, "the spring is stretched")
    time.sleep(0.3)
    assert force() == pytest.approx(wanted, rel=0.05)
    assert np.isfinite(lbr_commands(listener, "left")[1]).all()
    assert np.abs(lbr_commands(listener, "right")[1]).max() < 0.5
