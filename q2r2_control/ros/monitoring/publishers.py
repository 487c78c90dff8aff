"""Which nodes publish on a topic, so that a message about missing data can name who should have sent it."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

_FRESH = 0.1  # the graph's answer is good for so long [s]
_PERIOD = 1.0  # of the looks of a node that has no other reason to look [s]


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
