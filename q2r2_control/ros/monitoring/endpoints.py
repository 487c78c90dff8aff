"""The other ends of a topic: which nodes publish on it, and whether its subscribers still acknowledge messages."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from functools import partial
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import serialize_message

from q2r2_control.ros.base_node import SENT_COMMAND_QOS, STREAM_QOS, BaseNode

_MAX_AGE = 0.1  # of the graph's answer, before it is asked again [s]
_PERIOD = 0.5  # of asking the graph where no other code asks [s]
_NO_WAIT = Duration(nanoseconds=0)
# A subscriber may take 5 ms to acknowledge, longer than the period of a fast stream. So messages are left out every
# _CHECK seconds, until the one before has been acknowledged, or for at most _GAP seconds.
_CHECK, _GAP = 0.05, 0.015
_ASKED = 0.02  # after all was acknowledged, it is asked again [s]
_LIFESPAN = SENT_COMMAND_QOS.lifespan.nanoseconds * 1e-9  # [s]


# By the number of an endpoint, which is unique. A node that the graph has lost, such as one that was frozen or
# unreachable for longer than its lease, comes back with the same endpoints, and Fast DDS never learns their node again.
_known: dict[bytes, str] = {}


def node_of(endpoint: Any) -> str | None:
    """Full name of the node that an endpoint of the graph belongs to; None while it was never known."""
    number = bytes(endpoint.endpoint_gid)
    if not endpoint.node_name.startswith("_NODE_NAME_"):  # as rcl puts it
        _known[number] = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
    return _known.get(number)


class Publishers:
    """Which nodes publish on some topics, asked now and then; names are kept after a node has left the graph.

    The graph lists one that was killed for some seconds more, beside its successor.
    """

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        self._node = node
        self._names: dict[str, str] = dict.fromkeys(topics, "")
        self._asked_at = dict.fromkeys(self._names, -math.inf)
        # While /clock stands still, too.
        node.create_timer(_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def of(self, topic: str) -> str:
        """Full names of the nodes that publish on ``topic``, or of the last ones that did; "" if there were none."""
        if time.monotonic() - self._asked_at[topic] > _MAX_AGE:
            self._ask(topic)
        return self._names[topic]

    def source(self, topic: str) -> str:
        """The same for the middle of a sentence: " from /node", or "" if there were none."""
        names = self.of(topic)
        return f" from {names}" if names else ""

    def _look(self) -> None:
        for topic in self._names:
            self._ask(topic)

    def _ask(self, topic: str) -> None:
        self._asked_at[topic] = time.monotonic()
        names = {node_of(endpoint) for endpoint in self._node.get_publishers_info_by_topic(topic)}
        if known := sorted(name for name in names if name is not None):
            self._names[topic] = " and ".join(known)


def publish_in_time(publisher: Any, message: Any, decided: float) -> bool:
    """Publish what was decided on at ``decided`` [s] of the steady clock, unless its lifespan is over; whether it was.

    The middleware counts the lifespan from the publishing: a process that is frozen before would send a command of the
    past, a jump. Serializing takes most of the time until the message is sent; :mod:`delay_watch` covers the rest.
    """
    data = message if isinstance(message, bytes) else serialize_message(message)
    in_time = time.monotonic() - decided <= _LIFESPAN
    if in_time:
        publisher.publish(data)
    return in_time


class WatchedPublisher:
    """A publisher of targets or commands that notices when a subscriber was killed or hangs: it acknowledges no more.

    The graph lists such a subscriber for seconds. Meanwhile the targets move on, and a subscriber that is started in
    its place would begin with a jump. A stream of which nothing was ever acknowledged is not judged, because the
    remains of a subscriber that ended earlier do not acknowledge either. Best-effort subscribers never acknowledge and
    do not count. All times are real time, also where a simulation has its own.
    """

    def __init__(self, node: Node, kind: type, topic: str, timeout: float) -> None:
        self._publisher: Any = node.create_publisher(kind, topic, SENT_COMMAND_QOS)
        self._timeout = timeout
        self.sent = 0
        self._streaming = False
        self._acknowledged: float | None = None  # when all messages last were; None: not yet in this stream [s]
        self._gap_began = -math.inf  # [s]

    @property
    def topic_name(self) -> str:
        return str(self._publisher.topic_name)

    @property
    def listeners(self) -> int:
        """How many subscribers the graph lists; some may have ended."""
        return int(self._publisher.get_subscription_count())

    def begin(self, acknowledged: bool = False) -> None:
        """The next message begins a stream; with ``acknowledged`` all that was sent before counts as acknowledged."""
        self._streaming, self._gap_began = False, -math.inf
        self._acknowledged = time.monotonic() if acknowledged else None

    def publish(self, message: Any, decided: float) -> bool:
        """Publish a message of the stream; ``decided`` and what it returns: see :func:`publish_in_time`."""
        published = publish_in_time(self._publisher, message, decided)
        self.sent += 1
        self._streaming = True
        return published

    def waits(self) -> bool:
        """Whether the next message should be left out, so that the last one can be acknowledged."""
        now = time.monotonic()
        if not self._streaming or (self._acknowledged is not None and now - self._acknowledged < _CHECK):
            return False
        if self._publisher.wait_for_all_acked(_NO_WAIT):
            self._acknowledged = now
            return False
        if now - self._gap_began >= _CHECK:
            self._gap_began = now
        return now - self._gap_began < _GAP

    def silence(self) -> str | None:
        """One line if nothing was acknowledged for longer than the timeout; call it before each message."""
        if not self._streaming:
            return None
        now = time.monotonic()
        if self._acknowledged is not None and now - self._acknowledged < _ASKED:
            return None
        if self._publisher.wait_for_all_acked(_NO_WAIT):
            self._acknowledged = now
        if self._acknowledged is None or now - self._acknowledged <= self._timeout:
            return None
        return f"messages on {self.topic_name} are not acknowledged for {now - self._acknowledged:.2f} s"


class CommandWatch:
    """Listens to a node's own command topics while the node itself sends nothing there.

    Best effort, so that nobody waits for its acknowledgements or takes it for a robot's driver that does not answer.
    """

    def __init__(self, node: BaseNode, kind: type, topics: Iterable[str]) -> None:
        self._node, self._kind = node, kind
        self._heard = dict.fromkeys(topics, -math.inf)  # the last command on each [s]
        self._subscriptions: list[Any] = []

    def begin(self) -> None:
        """Listen from now on."""
        if not self._subscriptions:
            self._subscriptions = [
                self._node.create_subscription(self._kind, topic, partial(self._on_command, topic), STREAM_QOS)
                for topic in self._heard
            ]

    def end(self) -> None:
        """Listen no more: what comes from now on is the node's own."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def commander(self, within: float) -> str | None:
        """One line if commands came within the last seconds, else None."""
        now = time.monotonic()
        for topic, heard in self._heard.items():
            if now - heard <= within:
                own = self._node.get_fully_qualified_name()
                names = {node_of(info) or "a node" for info in self._node.get_publishers_info_by_topic(topic)} - {own}
                return f"{', '.join(sorted(names)) or 'another node'} commands the arms on {topic}"
        return None

    def _on_command(self, topic: str, message: Any) -> None:
        self._heard[topic] = time.monotonic()
