"""A publisher notices that its subscriber is gone: tested with a real one that is frozen and killed."""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import Any

import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes, RosProcess
from tests.ros.waiting import wait_until

need_ros()

from geometry_msgs.msg import PoseStamped
from rclpy.topic_endpoint_info import TopicEndpointInfo

from q2r2_control.ros.monitoring import WatchedPublisher, node_of

_LOST = "_NODE_NAME_UNKNOWN_"  # as rcl says
TIMEOUT = 0.5  # longer than an acknowledgement takes on an overloaded machine [s]
LISTENER = """
import rclpy
from geometry_msgs.msg import PoseStamped
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(PoseStamped, "watched", lambda message: None, 1)
rclpy.spin(node)
"""


class Stream:
    """Publishes as an arm controller does."""

    def __init__(self, publisher: WatchedPublisher, rate: float) -> None:
        self._publisher, self._period = publisher, 1.0 / rate
        self.published = self.left_out = 0

    def run(self, seconds: float) -> str | None:
        """Publish for so long; returns the reported silence of the listener, if there was one."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if (silence := self._publisher.silence()) is not None:
                return silence
            if self._publisher.waits():
                self.left_out += 1
            else:
                self._publisher.publish(PoseStamped(), time.monotonic())
                self.published += 1
            time.sleep(self._period)
        return None


@pytest.fixture
def listener(processes: Processes) -> RosProcess:
    return processes.start(sys.executable, "-c", LISTENER, name="listener")


@pytest.mark.parametrize(("rate", "acknowledged"), [(50.0, False), (500.0, True)])
def test_a_frozen_listener_is_reported_and_a_running_one_never(
    rate: float, acknowledged: bool, node: Any, listener: RosProcess
) -> None:
    publisher = WatchedPublisher(node, PoseStamped, "/watched", TIMEOUT)
    wait_until(lambda: publisher.listeners == 1, "the listener is found")
    publisher.begin(acknowledged)
    stream = Stream(publisher, rate)
    assert stream.run(2.0) is None
    assert stream.published > stream.left_out
    os.kill(listener.pid, signal.SIGSTOP)
    silence = stream.run(10.0 * TIMEOUT)
    assert silence is not None
    assert silence.startswith("messages on /watched are not acknowledged for 0.")
    os.kill(listener.pid, signal.SIGCONT)
    wait_until(lambda: publisher.silence() is None, "it is there again")


def test_a_listener_that_ended_before_the_stream_is_not_reported(
    node: Any, listener: RosProcess, processes: Processes
) -> None:
    publisher = WatchedPublisher(node, PoseStamped, "/watched", TIMEOUT)
    wait_until(lambda: publisher.listeners == 1, "the listener is found")
    os.kill(listener.pid, signal.SIGKILL)
    listener.wait()
    publisher.begin()
    assert Stream(publisher, 100.0).run(3.0 * TIMEOUT) is None
    assert publisher.listeners == 1  # as the graph says


def test_an_endpoint_keeps_the_name_of_its_node_where_the_graph_has_lost_it() -> None:
    known, lost, other = (
        TopicEndpointInfo(node_namespace=space, node_name=name, endpoint_gid=[number] * 16)
        for space, name, number in (("/", "talker", 1), ("_NODE_NAMESPACE_UNKNOWN_", _LOST, 1), ("/", _LOST, 2))
    )
    assert [node_of(one) for one in (known, lost, other)] == ["/talker", "/talker", None]


# How long Fast DDS takes to find it again is its own business, and once was more than 30 s.
@pytest.mark.slow
@pytest.mark.soak
def test_a_node_that_was_frozen_until_the_graph_had_lost_it_is_known_when_it_comes_back(
    node: Any, listener: RosProcess
) -> None:
    def nodes() -> list[str | None]:
        return [node_of(info) for info in node.get_subscriptions_info_by_topic("/watched")]

    node.create_publisher(PoseStamped, "/watched", 1)
    wait_until(lambda: nodes() == ["/listener"], "the listener and its name are found")
    os.kill(listener.pid, signal.SIGSTOP)
    wait_until(lambda: nodes() == [], "the graph has lost it")
    os.kill(listener.pid, signal.SIGCONT)
    wait_until(lambda: nodes() == ["/listener"], "it is found again")
