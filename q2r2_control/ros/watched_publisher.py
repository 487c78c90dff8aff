"""A publisher of commands that knows whether anybody still takes them."""

from __future__ import annotations

from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node

from q2r2_control.ros.node import SENT_COMMAND_QOS, BaseNode

_AT_ONCE = Duration(nanoseconds=0)


def listener_timeout(node: BaseNode, description: str) -> float:
    """Declare the parameter of this name and return its value [s]."""
    return float(node.parameter("listener_timeout", 0.15, description, at_least=0.05, at_most=10.0))


class WatchedPublisher:
    """Finds out about a listener that was killed or hangs: it acknowledges nothing any more.

    The graph keeps such a listener for 20 s. Meanwhile a hand moves on, and whoever is started in the listener's place
    would be asked to be where the hand is by then. A stream that never was acknowledged is not judged, since what is
    left of a listener that ended before does not acknowledge either. Best-effort listeners never do, nor need to.
    """

    def __init__(self, node: Node, kind: type, topic: str, timeout: float) -> None:
        self._publisher: Any = node.create_publisher(kind, topic, SENT_COMMAND_QOS)
        self._timeout = timeout
        self._streaming = False
        self._acknowledged: float | None = None  # when all was last; None: not yet in this stream [s]

    @property
    def topic_name(self) -> str:
        return str(self._publisher.topic_name)

    @property
    def listeners(self) -> int:
        """How many are known; some may be no more."""
        return int(self._publisher.get_subscription_count())

    def begin(self) -> None:
        """The next message begins a stream."""
        self._streaming, self._acknowledged = False, None

    def publish(self, message: Any) -> None:
        """Publish a message of the stream."""
        self._publisher.publish(message)
        self._streaming = True

    def silence(self, now: float) -> str | None:
        """One line where nothing was acknowledged for too long at ``now`` [s].

        To be asked before each message: the newest is as old as the stream's period then, and was acknowledged.
        """
        if not self._streaming:
            return None
        if self._publisher.wait_for_all_acked(_AT_ONCE):
            self._acknowledged = now
        if self._acknowledged is None or now - self._acknowledged <= self._timeout:
            return None
        return f"commands on {self.topic_name} are not acknowledged for {now - self._acknowledged:.2f} s"
