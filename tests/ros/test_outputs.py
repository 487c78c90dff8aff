"""When an output gives its receiver up: not while the arms follow, and never a receiver of torques."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.waiting import wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)

from std_msgs.msg import Float64MultiArray

from q2r2_control import Robot, load_config
from q2r2_control.drives import make_drive
from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.ros.bridge.joint_messages import PositionArray, TorqueArray
from q2r2_control.ros.bridge.joint_outputs import Channel, JointOutput
from q2r2_control.ros.monitoring.endpoints import WatchedPublisher

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
