"""Find other publishers of topics that may have one publisher only: hands, targets and commands.

A publisher that appears is found in the graph within 0.04 s after the middleware has discovered it. An older
publisher that was silent is found by its first message.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from functools import partial
from typing import Any

from q2r2_control.events import Reason
from q2r2_control.ros.base_node import STREAM_QOS, BaseNode
from q2r2_control.ros.monitoring import WatchedPublisher, node_of
from q2r2_control.ros.reasons import RosReason

_DISCOVERY = 1.0  # Publishers that a new node discovers within this time count as older than the node [s].
_GRAPH_PERIOD = 0.04  # Time between two queries of the graph [s].
_UNKNOWN = "a node not known yet"  # The graph lists an endpoint before the name of the endpoint's node.
HEARD = 0.3  # A node that sent a command within this time is a commander [s].


def publishers_of(node: BaseNode, topic: str, *, own: bool = True) -> str:
    """Return the names of the nodes that publish on ``topic``, for a sentence. With ``own``, this node is included."""
    leave_out = None if own else node.get_fully_qualified_name()
    names = {node_of(info) or _UNKNOWN for info in node.get_publishers_info_by_topic(topic)}
    return " and ".join(sorted(names - {leave_out})) or "another node"


def takers_of(node: BaseNode, topic: str) -> str:
    """Return the names of the other nodes that subscribe to ``topic``, for a sentence; "" if there are none."""
    found = {node_of(info) or _UNKNOWN for info in node.get_subscriptions_info_by_topic(topic)}
    return " and ".join(sorted(found - {node.get_fully_qualified_name()}))


class OnePublisher:
    """Checks whether topics, given by full name, have more than one publisher. Every tick may call :meth:`conflict`."""

    def __init__(self, node: BaseNode, topics: Iterable[str]) -> None:
        self._node, self._topics = node, tuple(topics)
        self._asked_at = -math.inf  # Time of the newest query of the graph [s].
        self._found: Reason | None = None

    def conflict(self) -> Reason | None:
        """Return a reason for the first topic that has several publishers, or None."""
        if (now := time.monotonic()) - self._asked_at >= _GRAPH_PERIOD:
            self._asked_at, self._found = now, next(filter(None, map(self._look, self._topics)), None)
        return self._found

    def _look(self, topic: str) -> Reason | None:
        if (count := self._node.handle.get_count_publishers(topic)) <= 1:
            return None
        named = f"{topic} ({publishers_of(self._node, topic)})"
        return Reason.of(RosReason.SEVERAL_PUBLISHERS, count=count, topic=named)


class CommandWatch:
    """Watches for other publishers of the topics on which a node commands arms.

    While the node commands, :meth:`intruder` finds a new publisher, and an earlier publisher that begins to send. While
    the node does not command, it may listen, and :meth:`commander` tells whether another node commands. The node
    listens by best effort, so that no publisher waits for its acknowledgements. It also receives its own commands. It
    recognises them by their bytes, because rclpy does not say who sent a message.
    """

    def __init__(self, node: BaseNode, kind: type, publishers: Iterable[WatchedPublisher]) -> None:
        self._node, self._kind = node, kind
        self._publishers = {publisher.topic_name: publisher for publisher in publishers}
        self._heard = dict.fromkeys(self._publishers, -math.inf)  # Time of the last command of another node [s].
        self._subscriptions: list[Any] = []
        self._born = time.monotonic()
        self._asked_at = -math.inf  # Time of the last query of the graph [s].
        # Number of other publishers at the last query; None while this node does not command.
        self._known: int | None = None
        self._found: Reason | None = None  # Another commander that was found since this node began to command.

    def begin(self) -> None:
        """Begin to listen to commands."""
        if self._subscriptions:
            return
        for topic, publisher in self._publishers.items():
            on_command = partial(self._on_command, topic)
            made = self._node.create_subscription(self._kind, topic, on_command, STREAM_QOS, raw=True)
            self._subscriptions.append(made)
            publisher.own_listeners = 1

    def end(self) -> None:
        """Cease to listen to commands."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in self._publishers.values():
            publisher.own_listeners = 0
        self._subscriptions = []

    def commander(self, within: float = HEARD) -> Reason | None:
        """Return a reason if another node has sent a command in the last ``within`` seconds, else None."""
        now = time.monotonic()
        topics = (topic for topic, heard in self._heard.items() if now - heard <= within)
        return next(map(self._reason, topics), None)

    def intruder(self) -> Reason | None:
        """Return why this node may not go on commanding, or None. It is called before each command."""
        if self._known is not None and time.monotonic() - self._asked_at < _GRAPH_PERIOD:
            self._found = self._found or self.commander()
            return self._found
        self._asked_at = time.monotonic()
        counts = {topic: self._node.handle.get_count_publishers(topic) - 1 for topic in self._publishers}
        others = sum(counts.values())
        if self._known is None:
            self._known, self._found = others, None
        if others > self._known and time.monotonic() - self._born > _DISCOVERY:
            self._found = next(self._reason(topic) for topic, count in counts.items() if count > 0)
        self._known = others
        if others:
            self.begin()
        else:
            self.end()
        self._found = self._found or self.commander()
        return self._found

    def named(self, reason: Reason) -> Reason:
        """Return ``reason``. If names of nodes were unknown when it was made, it gets the names that are known now."""
        if reason.kind is not RosReason.OTHER_COMMANDER or _UNKNOWN not in reason.detail["nodes"]:
            return reason
        return self._reason(reason.detail["topic"])

    def rest(self) -> None:
        """Record that this node has ceased to command. Publishers that exist when it begins again are not new."""
        self._known = None

    def _reason(self, topic: str) -> Reason:
        return Reason.of(RosReason.OTHER_COMMANDER, nodes=publishers_of(self._node, topic, own=False), topic=topic)

    def _on_command(self, topic: str, message: bytes) -> None:
        if not self._publishers[topic].is_own(bytes(message)):
            self._heard[topic] = time.monotonic()
