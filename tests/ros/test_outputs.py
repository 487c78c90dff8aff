"""What an output sends, and when it gives its receiver up: not while the arms follow, never a receiver of torques."""

from __future__ import annotations

import time
from queue import Queue
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from tests.ros.conftest import need_ros
from tests.ros.waiting import wait_until

need_ros()

from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from q2r2_control import Robot, load_config
from q2r2_control.drives.base import make_drive
from q2r2_control.errors import ConfigError
from q2r2_control.ros.base_node import COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge import joint_outputs
from q2r2_control.ros.bridge.joint_outputs import (
    Channel,
    JointOutput,
    LbrPosition,
    LbrTorque,
    PositionArray,
    TorqueArray,
    make_output,
)
from q2r2_control.ros.monitoring import WatchedPublisher
from q2r2_control.types import Command, CommandMode, RobotState

TIMEOUT = 0.5  # more than a busy machine takes to acknowledge [s]


class Commands:
    """Sends commands, and listens to them as a joint controller."""

    def __init__(self, node: Any, positions: bool) -> None:
        self._node, self.taken = node, 0
        self._publisher = WatchedPublisher(node, Float64MultiArray, "/commands", TIMEOUT)
        self._channel = Channel([], np.arange(0), self._publisher)
        config = load_config("config/dual_iiwa7.yaml")
        robot = Robot.from_config(config)
        kind = PositionArray if positions else TorqueArray
        drive = make_drive(kind.mode, robot, config, has_servos=False)
        self.output = JointOutput(drive, kind(0.004, robot), [self._channel])
        self.listen()

    def listen(self) -> None:
        """One more listener."""
        known = self._publisher.listeners
        self._node.create_subscription(Float64MultiArray, "/commands", self._take, COMMAND_QOS)
        wait_until(lambda: self._publisher.listeners > known, "the listener is found")

    def send(self, seconds: float, off_reference: bool) -> str | None:
        """Send 200 commands a second; what was found to be wrong, if anything."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (fault := self.output.listener_fault(off_reference)) is not None:
                return fault
            if not self.output.waits():
                self._publisher.publish(Float64MultiArray(), time.monotonic())
            time.sleep(0.005)
        return None

    def _take(self, message: Float64MultiArray) -> None:
        self.taken += 1


def test_a_receiver_of_positions_is_not_given_up_while_the_arms_are_off_their_reference(node: Any) -> None:
    commands = Commands(node, positions=True)
    assert commands.send(0.2, off_reference=False) is None
    before = commands.taken
    assert commands.send(3.0 * TIMEOUT, off_reference=True) is None
    assert commands.taken - before > 100  # of some 300: the others were left out, or late on a busy machine


@pytest.mark.parametrize(("positions", "off_reference"), [(True, True), (True, False), (False, True)])
def test_a_new_receiver_of_positions_is_noticed_where_the_arms_are_off_their_reference(
    positions: bool, off_reference: bool, node: Any
) -> None:
    commands = Commands(node, positions)
    assert commands.send(0.2, off_reference=False) is None
    commands.listen()
    fault = commands.send(0.2, off_reference)
    assert (fault is not None and "new receiver" in fault) == (positions and off_reference)


def test_arms_with_a_topic_each_get_their_own_joints_there(node: Any, robot: Robot, context: Any) -> None:
    # The right arm's topic is by the pattern for all, the left one's by itself.
    given = ("output_topic:=/{arm}/commands", "left.output_topic:=/left/commands")
    sender = BaseNode("sender", context=context, cli_args=["--ros-args", *(p for g in given for p in ("-p", g))])
    output = make_output("trajectory", sender, robot, load_config("config/dual_iiwa7.yaml"), 0.004)
    assert set(output.sent) == {"/left/commands", "/right/commands"}
    taken: Queue[Any] = Queue()
    node.create_subscription(JointTrajectory, "/right/commands", taken.put, COMMAND_QOS)
    q, zero = robot.home, np.zeros_like(robot.home)
    state = RobotState(q, zero, zero, None, 0.0)
    command = Command(CommandMode.POSITION, q, zero, zero, {})
    wait_until(lambda: sender.count_subscribers("/right/commands"), "the listener is found")
    while taken.empty():
        output.send(command, state, 0.0, time.monotonic())
        time.sleep(0.02)
    message = taken.get()
    assert message.joint_names == [name for name in robot.joint_names if name.startswith("right")]
    assert list(message.points[0].positions) == q[robot.arms["right"].joints].tolist()
    sender.destroy_node()


def test_torques_for_an_lbr_are_without_gravity_and_come_with_its_measured_positions(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="lbr_fri_idl cannot be imported"):
        LbrTorque(0.004, robot)
    monkeypatch.setattr(joint_outputs, "_lbr_message", lambda name: SimpleNamespace)
    q, zero = robot.home + 0.1, np.zeros_like(robot.home)
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    command = Command(CommandMode.TORQUE, robot.home, zero, gravity + 1.0, {})
    joints = robot.arms["left"].joints
    to_send = command, RobotState(q, zero, zero, None, 0.0), 0.0
    sent = LbrTorque(0.004, robot).encode(*to_send, [], joints)
    np.testing.assert_allclose(sent.torque, 1.0)
    np.testing.assert_array_equal(sent.joint_position, q[joints])
    sent = LbrPosition(0.004, robot).encode(*to_send, [], joints)
    np.testing.assert_array_equal(sent.joint_position, robot.home[joints])
