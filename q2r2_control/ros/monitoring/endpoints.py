"""The other ends of a topic: which nodes publish on it, and whether those that listen still take what is sent."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from q2r2_control.ros.base_node import SENT_COMMAND_QOS

_FRESH = 0.1  # the graph's answer is good for so long [s]
_PERIOD = 1.0  # of the looks of a node that has no other reason to look [s]
_AT_ONCE = Duration(nanoseconds=0)
# A listener may take 5 ms to acknowledge, longer than the period of a fast stream. So now and then a message is left
# out until the one before has been acknowledged, or for this long [s].
_LOOK, _GAP = 0.05, 0.015


class Publishers:
    """Remembers the publishers' nodes, since those that have ended leave the graph at once or after a while.

    The graph is asked now and then and never for each message. Two publishers of one topic may also be one that was
    killed, which the graph does not tell, and the one that was started in its place.
    """

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        self._node = node
        self._names: dict[str, str] = dict.fromkeys(topics, "")
        self._asked_at = dict.fromkeys(self._names, -math.inf)

    def look_steadily(self) -> None:
        """Let the node look now and then by itself."""
        self._node.create_timer(_PERIOD, self.look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def look(self) -> None:
        """Ask the graph about all topics."""
        for topic in self._names:
            self._ask(topic)

    def of(self, topic: str) -> str:
        """Full names of the nodes that publish on ``topic``, or did when there last were any; "" for none ever."""
        if time.monotonic() - self._asked_at[topic] > _FRESH:
            self._ask(topic)
        return self._names[topic]

    def source(self, topic: str) -> str:
        """The same for the middle of a sentence: " from /node", or nothing."""
        names = self.of(topic)
        return f" from {names}" if names else ""

    def _ask(self, topic: str) -> None:
        self._asked_at[topic] = time.monotonic()
        infos = self._node.get_publishers_info_by_topic(topic)
        # A publisher may be known before its node is.
        known = [info for info in infos if not info.node_name.startswith("_NODE_NAME_")]
        if known:
            names = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in known}
            self._names[topic] = " and ".join(sorted(names))


class WatchedPublisher:
    """Finds out about a listener that was killed or hangs: it acknowledges nothing any more.

    The graph keeps such a listener for seconds. Meanwhile a hand moves on, and whoever is started in its place would be
    asked to be where the hand is by then. A stream that never was acknowledged is not judged, since what is
    left of a listener that ended before does not acknowledge either. Best-effort listeners never do, nor need to.
    Acknowledging takes real time, whatever time a simulation has.
    """

    def __init__(self, node: Node, kind: type, topic: str, timeout: float) -> None:
        self._publisher: Any = node.create_publisher(kind, topic, SENT_COMMAND_QOS)
        self._timeout = timeout
        self._streaming = False
        self._acknowledged: float | None = None  # when all was last; None: not yet in this stream [s]
        self._gap_began = -math.inf  # [s]

    @property
    def topic_name(self) -> str:
        return str(self._publisher.topic_name)

    @property
    def listeners(self) -> int:
        """How many are known; some may be no more."""
        return int(self._publisher.get_subscription_count())

    def begin(self, acknowledged: bool = False) -> None:
        """The next message begins a stream; where what was sent before is taken as ``acknowledged`` it is judged."""
        self._streaming, self._gap_began = False, -math.inf
        self._acknowledged = time.monotonic() if acknowledged else None

    def publish(self, message: Any) -> None:
        """Publish a message of the stream."""
        self._publisher.publish(message)
        self._streaming = True

    def waits(self) -> bool:
        """Whether the next message is better left out, so that the last one can be acknowledged."""
        now = time.monotonic()
        if not self._streaming or (self._acknowledged is not None and now - self._acknowledged < _LOOK):
            return False
        if now - self._gap_began >= _LOOK:
            self._gap_began = now
        return now - self._gap_began < _GAP

    def silence(self) -> str | None:
        """One line where nothing was acknowledged for too long; to be asked before each message."""
        if not self._streaming:
            return None
        now = time.monotonic()
        if self._publisher.wait_for_all_acked(_AT_ONCE):
            self._acknowledged = now
        if self._acknowledged is None or now - self._acknowledged <= self._timeout:
            return None
        return f"messages on {self.topic_name} are not acknowledged for {now - self._acknowledged:.2f} s"
