"""Layouts and kinds of command: a namespace an arm, torques, an LBR's messages; each moves the simulated robot."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot, load_config
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.ros.node import COMMAND_QOS
from tests.ros.cell import CONFIG, PATIENT, STILL, Cell, at_rest, parameters, start, wait

TARGETS = "/{arm}/target_pose"
TARGET_TOPICS = [f"{arm}.target_topic:=/{arm}/target_pose" for arm in ("left", "right")]


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config(CONFIG))


@pytest.fixture(scope="module")
def started(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    """One simulated robot for all tests; each brings a controller of its own."""
    processes = Processes(tmp_path_factory.mktemp("cell"), os.environ)
    with spun_node(domain) as node:
        yield Cell(node, robot, start(processes, "mujoco_robot"), targets=TARGETS)
        processes.end_all()


@pytest.fixture
def cell(started: Cell) -> Cell:
    """At home, commanded by nobody."""
    wait(lambda: started.state("mode", "mujoco_robot") == "holding", "the robot holds")
    started.call("/mujoco_robot/reset")
    started.states.pop("cartesian_controller", None)
    started.measured.clear()
    wait(lambda: started.measured, "joint states come")
    return started


class Relay:
    """Between a robot that knows one topic of all arms, and a controller with a namespace an arm."""

    def __init__(self, node: Any, robot: Robot) -> None:
        self._node, self.silent = node, ""  # the arm whose joint states it keeps back
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
            columns = [i for i, name in reversed(list(enumerate(message.name))) if name.startswith(arm)]
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
    cell: Cell, robot: Robot, relay: Relay, processes: Processes
) -> None:
    layout = [f"{arm}.joint_states_topic:=/{arm}/joint_states" for arm in robot.arms]
    # Its right arm is named by the pattern for all, its left one by itself.
    layout += ["output_topic:=/{arm}/arm_controller/joint_trajectory"]
    layout += ["left.output_topic:=/left/arm_controller/joint_trajectory"]
    start(processes, "cartesian_controller", *parameters(*TARGET_TOPICS, *layout), *PATIENT)
    cell.wait_until_active()
    stream = cell.engage("left", "right")
    begin = cell.q
    stream.move("left", (0.0, 0.0, 0.05))
    stream.move("right", (0.05, 0.0, 0.0))
    for arm in robot.arms:
        goal = stream.poses[arm].translation
        wait(lambda arm=arm, goal=goal: np.linalg.norm(cell.tool(arm).translation - goal) < 3e-3, f"{arm} is there")
    assert np.abs(cell.q - begin).max() > 0.05
    joints = {arm: tuple(name for name in robot.joint_names if name.startswith(arm)) for arm in robot.arms}
    assert relay.commanded == {arm: {names} for arm, names in joints.items()}

    relay.silent = "right"
    wait(lambda: cell.state("level") == "error", "the stall is reported")
    assert "no joint states from /test on /right/joint_states for 0." in cell.state("message")
    relay.silent = ""
    wait(lambda: cell.state("phase") == "active", "the controller is active again")
    stream.end()


def test_torques_move_an_arm_and_leave_it_on_its_servos_when_the_controller_is_killed(
    cell: Cell, processes: Processes
) -> None:
    controller = start(processes, "cartesian_controller", *parameters(*TARGET_TOPICS, "output:=torque"), *PATIENT)
    cell.wait_until_active()
    wait(lambda: cell.state("mode", "mujoco_robot") == "torque", "the robot is driven by torques")
    stream = cell.engage("left")
    stream.move("left", (0.0, 0.0, 0.05), speed=0.1)
    goal = stream.poses["left"].translation
    wait(lambda: np.linalg.norm(cell.tool("left").translation - goal) < 3e-3, "the arm is there")
    before = at_rest(cell)
    assert np.linalg.norm(cell.tool("left").translation - goal) < 3e-3
    assert cell.state("mode", "mujoco_robot") == "torque"
    cell.measured.clear()
    os.kill(controller.pid, signal.SIGKILL)
    stream.end()
    wait(lambda: cell.state("mode", "mujoco_robot") == "holding", "the robot holds")
    time.sleep(0.5)
    assert max(np.abs(measured.q - before).max() for measured in cell.measured) < STILL
