"""Whom an output doubts: nobody while the arms follow, and never who takes torques."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.waiting import wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)

from std_msgs.msg import Float64MultiArray

from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.ros.bridge.outputs import Channel, ChannelOutput
from q2r2_control.ros.monitoring.endpoints import WatchedPublisher

TIMEOUT = 0.5  # more than a busy machine takes to acknowledge [s]


class Commands:
    """Sends commands, and listens to them as a joint controller."""

    def __init__(self, node: Any, doubts: bool) -> None:
        self._node, self.taken = node, 0
        self._publisher = WatchedPublisher(node, Float64MultiArray, "/commands", TIMEOUT)
        self._channel = Channel([], np.arange(0), self._publisher)
        self.output = ChannelOutput([self._channel], doubts)
        self.listen()

    def listen(self) -> None:
        """One more listener."""
        known = self._publisher.listeners
        self._node.create_subscription(Float64MultiArray, "/commands", self._take, COMMAND_QOS)
        wait_until(lambda: self._publisher.listeners > known, "the listener is found")

    def send(self, seconds: float, astray: bool) -> str | None:
        """Send 200 commands a second; what came of a doubt, if anything did."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (fault := self.output.doubt(astray)) is not None:
                return fault
            self._channel.send(Float64MultiArray())
            time.sleep(0.005)
        return None

    def _take(self, message: Float64MultiArray) -> None:
        self.taken += 1


def test_who_takes_positions_is_not_given_up_while_the_arms_stand_elsewhere(node: Any) -> None:
    commands = Commands(node, doubts=True)
    assert commands.send(0.2, astray=False) is None
    before = commands.taken
    assert commands.send(3.0 * TIMEOUT, astray=True) is None
    assert commands.taken - before > 100  # of some 300: the others were left out, or late on a busy machine


@pytest.mark.parametrize(("doubts", "astray"), [(True, True), (True, False), (False, True)])
def test_somebody_new_is_doubted_where_the_arms_do_not_go_where_positions_ask(
    doubts: bool, astray: bool, node: Any
) -> None:
    commands = Commands(node, doubts)
    assert commands.send(0.2, astray=False) is None
    commands.listen()
    fault = commands.send(0.2, astray)
    assert (fault is not None and "somebody new" in fault) == (doubts and astray)
