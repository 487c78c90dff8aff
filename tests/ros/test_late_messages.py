"""A target or command that took long to arrive is not used: its sender was frozen in the middle of sending it.

No program can be made to send late at will, so the subscriptions' callbacks get what the middleware would tell them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pinocchio as pin
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

import rclpy
from sensor_msgs.msg import JointState

from q2r2_control.ros.base_node import WARN, BaseNode
from q2r2_control.ros.bridge.intakes import TargetIntake
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.nodes.mujoco_robot import MujocoRobot

USUAL, LATE = 1_000_000, 1_000_000_000  # from sending to receipt [ns]


class Arrivals:
    """Calls the callback of a node's subscription as the executor does."""

    def __init__(self, node: Any, topic: str) -> None:
        self._subscription = next(one for one in node.subscriptions if one.topic_name == topic)
        self._number = 0

    def arrive(self, message: Any, took: int) -> None:
        self._number += 1
        received = 1_700_000_000_000_000_000 + self._number * 10_000_000
        times = {"source_timestamp": received - took, "received_timestamp": received}
        self._subscription.callback(message, {"publication_sequence_number": self._number, **times})


@pytest.fixture
def default_context(domain: int) -> Iterator[None]:
    rclpy.init(domain_id=domain)
    yield
    rclpy.try_shutdown()


def test_a_late_target_is_passed_on_as_none_and_reported(context: Any, robot: Robot) -> None:
    node = BaseNode("intake", context=context)
    intake = TargetIntake(node, robot, lambda: None)
    taken: list[bool] = []
    intake.subscribe(lambda arm, pose, *_: taken.append(pose is not None), lambda arm: None)
    targets = Arrivals(node, "/q2r2/left/target_frame")
    for took in (USUAL, USUAL, LATE, USUAL):
        targets.arrive(stamped_pose(pin.SE3.Identity(), "world", 0.0), took)
        if took == LATE:
            assert intake.faults() == ["target of left not used: 1.00 s late; its sender or this node stood still"]
    assert taken == [True, True, False, True]
    assert intake.rejected["left"] == 1
    assert intake.faults() == []
    node.destroy_node()


def test_a_late_command_does_not_move_the_simulated_robot_and_is_reported(
    default_context: None, robot: Robot, interfaces: None
) -> None:
    node = MujocoRobot()
    commands = Arrivals(node, "/joint_commands")
    command = JointState(name=list(robot.joint_names), position=robot.home.tolist())
    for took in (USUAL, USUAL):
        commands.arrive(command, took)
    assert node.health()[2]["refused_commands"] == 0
    commands.arrive(command, LATE)
    level, line, values = node.health()
    assert (level, values["refused_commands"]) == (WARN, 1)
    assert line == "joint_commands: refused: 1.00 s late; its sender or this node stood still"
    commands.arrive(command, USUAL)
    assert node.health()[2]["refused_commands"] == 1
    node.close()
    node.destroy_node()
