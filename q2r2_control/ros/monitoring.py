"""Observe other nodes: who publishes and subscribes, who still acknowledges, and what they report on ``~/state``."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from q2r2_control.events import Reason
from q2r2_control.ros.base_node import SENT_COMMAND_QOS, STEADY, STREAM_QOS
from q2r2_control.ros.reasons import LATENESS, NOT_EXPLAINED, RosReason
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.teleop.reasons import HOLD_REQUESTS

_MAX_AGE = 0.1  # If the graph's last answer is older than this, the graph is asked again [s].
_PERIOD = 2.0  # Time between two queries of the graph, if no other code queries it [s].
_NO_WAIT = Duration(nanoseconds=0)
# A subscriber can take 5 ms to acknowledge, which is longer than the period of a fast stream. Every _CHECK seconds
# messages are therefore left out until the last one has been acknowledged, for at most _GAP seconds.
_CHECK, _GAP = 0.05, 0.015
_ASKED = 0.02  # Time between two queries whether all messages were acknowledged [s].
_LIFESPAN = SENT_COMMAND_QOS.lifespan.nanoseconds * 1e-9  # A command that is older than this is not published [s].
_LATELY = 32  # Number of sent messages that are remembered. It exceeds the queue of the node's own subscription.
_STATE = "/state"
_LOOK_PERIOD = 0.3  # Time between two queries of the graph for nodes that report [s].
# Within this time after the first query of the graph, the node of every running arm has reported [s]. Nodes report
# twice a second.
_DISCOVERY = 2.0
_SILENT, _GONE = 2.0, 5.0  # Times without a report after which a node counts as silent, and as ended [s].
_ARM = {"engaged", "ready", "hand"}  # The keys by which the report of an arm's node is recognised.
# Names of nodes by the unique number of an endpoint. The graph loses a node that was frozen or unreachable for longer
# than its lease. The node comes back with the same endpoints, but Fast DDS does not learn its name again.
_known: dict[bytes, str] = {}


def node_of(endpoint: Any) -> str | None:
    """Return the full name of the node to which an endpoint belongs; None if this name was never known."""
    number = bytes(endpoint.endpoint_gid)
    if not endpoint.node_name.startswith("_NODE_NAME_"):  # rcl gives such a name if it does not know the node.
        _known[number] = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
    return _known.get(number)


class Publishers:
    """The nodes that publish on some topics. Their names are kept after a node has left the graph."""

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        self._node = node
        self._names: dict[str, str] = dict.fromkeys(topics, "")
        self._asked_at = dict.fromkeys(self._names, -math.inf)
        node.create_timer(_PERIOD, partial(self._ask, *self._names), clock=STEADY)

    def of(self, topic: str) -> str:
        """Return the full names of the nodes that publish on ``topic``.

        If no node publishes now, these are the names of the last publishers; "" if there never was a publisher.
        """
        if time.monotonic() - self._asked_at[topic] > _MAX_AGE:
            self._ask(topic)
        return self._names[topic]

    def source(self, topic: str) -> str:
        """Return the names of :meth:`of` as a part of a sentence, such as " from /node"; "" if there were none."""
        return f" from {names}" if (names := self.of(topic)) else ""

    def _ask(self, *topics: str) -> None:
        for topic in topics:
            self._asked_at[topic] = time.monotonic()
            names = {node_of(endpoint) for endpoint in self._node.get_publishers_info_by_topic(topic)}
            if known := sorted(name for name in names if name is not None):
                self._names[topic] = " and ".join(known)


def publish_in_time(publisher: Any, message: Any, decided: float) -> bool:
    """Publish a message, unless its lifespan is over; returns whether it was published.

    The middleware counts the lifespan from the moment of publishing. If the process was frozen before that moment, it
    would send an old command, and the arm would jump. The time is therefore checked after serialisation, which takes
    most of the time until the message is sent. If the process freezes after this check, the receiver's
    :class:`DelayWatch` notices it.

    Args:
        publisher: The publisher.
        message: The message.
        decided: The time at which the contents were decided on, by the steady clock [s].
    """
    data = message if isinstance(message, bytes) else serialize_message(message)
    in_time = time.monotonic() - decided <= _LIFESPAN
    if in_time:
        publisher.publish(data)
    return in_time


class WatchedPublisher:
    """A publisher of targets or commands that notices a killed or hanging subscriber, which acknowledges no more.

    The graph lists such a subscriber for seconds. Meanwhile the targets move on, and a new subscriber in its place
    would begin with a jump. If nothing of a stream was ever acknowledged, the stream is not judged, because the remains
    of an earlier subscriber do not acknowledge either. Best-effort subscribers never acknowledge, and do not count.
    A middleware on Zenoh has no acknowledgements and always reports that all was acknowledged. ``q2r2 ros doctor``
    warns of that. All times are real time, also with a simulated clock.
    """

    def __init__(self, node: Node, kind: type, topic: str, timeout: float) -> None:
        self._publisher: Any = node.create_publisher(kind, topic, SENT_COMMAND_QOS)
        self.topic_name: str = self._publisher.topic_name
        self._timeout = timeout
        self.sent = 0
        self._lately: deque[bytes] = deque(maxlen=_LATELY)
        self.own_listeners = 0  # Number of subscriptions of the same node, which acknowledge nothing.
        self._streaming = False
        # Time when all messages were last acknowledged [s]; None if this has not happened yet in this stream.
        self._acknowledged: float | None = None
        self._gap_began = -math.inf  # Time since which messages are left out [s].

    @property
    def listeners(self) -> int:
        """Return how many subscriptions of other nodes the ROS graph lists. It can still list nodes that have ended."""
        return int(self._publisher.get_subscription_count()) - self.own_listeners

    def is_own(self, data: bytes) -> bool:
        """Return whether a serialized message is one of the last messages that were published here."""
        return data in self._lately

    def begin(self, acknowledged: bool = False) -> None:
        """Let the next message begin a stream. With ``acknowledged``, all earlier messages count as acknowledged."""
        self._streaming, self._gap_began = False, -math.inf
        self._acknowledged = time.monotonic() if acknowledged else None

    def publish(self, message: Any, decided: float) -> bool:
        """Publish a message of the stream. See :func:`publish_in_time` for ``decided`` and the result."""
        data = message if isinstance(message, bytes) else serialize_message(message)
        self._lately.append(data)
        published = publish_in_time(self._publisher, data, decided)
        self.sent += 1
        self._streaming = True
        return published

    def waits(self) -> bool:
        """Return whether the next message should be left out, so that the last one can be acknowledged."""
        now = time.monotonic()
        if not self._streaming or (self._acknowledged is not None and now - self._acknowledged < _CHECK):
            return False
        if self._publisher.wait_for_all_acked(_NO_WAIT):
            self._acknowledged = now
            return False
        if now - self._gap_began >= _CHECK:
            self._gap_began = now
        return now - self._gap_began < _GAP

    def silence(self) -> Reason | None:
        """Return a reason if nothing was acknowledged for longer than the timeout. It is called before each message."""
        if not self._streaming:
            return None
        now = time.monotonic()
        if self._acknowledged is not None and now - self._acknowledged < _ASKED:
            return None
        if self._publisher.wait_for_all_acked(_NO_WAIT):
            self._acknowledged = now
        if self._acknowledged is None or now - self._acknowledged <= self._timeout:
            return None
        return Reason.of(RosReason.NOT_ACKNOWLEDGED, topic=self.topic_name, age=now - self._acknowledged)


class NodeStates:
    """The newest state of every node that reports one, by full name. The node that listens has to be spun."""

    def __init__(
        self,
        node: Node,
        on_state: Callable[[str, dict[str, Any]], None] = lambda name, state: None,
        namespace: str = "/",
    ) -> None:
        """Observe only the nodes in ``namespace``."""
        self._node, self._on_state, self._prefix = node, on_state, f"{namespace.rstrip('/')}/"
        self._heard: set[str] = set()  # The topics to which this object has subscribed.
        self.newest: dict[str, tuple[dict[str, Any], float]] = {}  # By node, the state and the time of receipt [s].

    def look(self) -> None:
        for topic, types in self._node.get_topic_names_and_types():
            ours = topic.startswith(self._prefix) and topic.endswith(_STATE)
            if ours and types == ["std_msgs/msg/String"] and topic not in self._heard:
                self._heard.add(topic)
                take = partial(self._take, topic.removesuffix(_STATE))
                self._node.create_subscription(String, topic, take, STREAM_QOS)

    def _take(self, name: str, message: String) -> None:
        try:
            state = json.loads(message.data)
        except ValueError:
            return  # The topic belongs to a node of another kind.
        if isinstance(state, dict) and {"level", "message"} <= state.keys():
            self.newest[name] = state, time.monotonic()
            self._on_state(name, state)


class HandListeners:
    """The nodes of arms that follow one of the given hands, as the nodes report on ``~/state``."""

    def __init__(self, node: Node, hands: Sequence[str]) -> None:
        self._states, self._hands = NodeStates(node, namespace=node.get_namespace()), hands
        self._began = self._asked_at = 0.0  # Times of the first and of the last query of the graph [s].
        # By controller, how often its services to hold, stop or go home had been called at the last :meth:`begin`.
        self._requests: dict[str, int] = {}

    def look(self) -> None:
        now = time.monotonic()
        if now - self._asked_at >= _LOOK_PERIOD:
            self._began, self._asked_at = self._began or now, now
            self._states.look()

    def unready(self) -> str | None:
        """Return one line that says why an arm cannot be engaged yet; None if there is no reason.

        In the first two seconds, the node of an arm may not have been found yet. If no arm has
        reported yet that it follows one of the hands, this is a reason as well.
        """
        if time.monotonic() - self._began < _DISCOVERY and any(self.engaged(hand) is None for hand in self._hands):
            return "an arm may be there that has not said yet what it does"
        for name, state, age in self._arms():
            if not state["engaged"] and age > _SILENT:
                return f"{name} is silent for {age:.0f} s"
            if not (state["engaged"] or state["ready"]):
                return f"{name}: {state['message']}"
        return None

    def engaged(self, hand: str) -> bool | None:
        """Return whether all arms that follow a hand are engaged; None if no arm follows it."""
        engaged = [state["engaged"] for _, state, _ in self._arms() if state["hand"] == hand]
        return all(engaged) if engaged else None

    def begin(self) -> None:
        """Ignore the requests that controllers have served until now."""
        self._requests.clear()
        self._new_requests()

    def asked_to_hold(self) -> bool:
        """Return whether a request to pause, reset, stop or go home was made.

        Such a request is an arm's last event, or a call of a controller's service since :meth:`begin`. A controller
        that was restarted counts its calls from 0 again. Its new number then also counts as a request.
        """
        return self._new_requests() or any(
            state.get("last_event_kind") in HOLD_REQUESTS for _, state, _ in self._arms()
        )

    def only_late(self) -> bool:
        """Return whether each arm that is not engaged was lost only because a node stood still or data came late."""
        ceased = {state["ceased_kind"] for state, _ in self._states.newest.values() if state.get("ceased_kind")}
        return ceased <= LATENESS and all(
            state.get("state") == ArmState.LOST
            and state.get("paused_kind") in (LATENESS | NOT_EXPLAINED if ceased else LATENESS)
            for _, state, _ in self._arms()
            if not state["engaged"]
        )

    def lost(self) -> dict[str, str]:
        """Return the reports of the nodes whose arms are lost, by name of the node.

        An arm is lost if a fault or a request has stopped it.
        """
        return {name: state["message"] for name, state, _ in self._arms() if state.get("state") == ArmState.LOST}

    def _new_requests(self) -> bool:
        counts = {name: state["requests"] for name, (state, _) in self._states.newest.items() if "requests" in state}
        return any(count != self._requests.setdefault(name, count) for name, count in counts.items())

    def _arms(self) -> list[tuple[str, dict[str, Any], float]]:
        """Return the name, the state and the state's age [s] for each arm's node that follows one of the hands."""
        now = time.monotonic()
        said = ((name, state, now - at) for name, (state, at) in self._states.newest.items())
        return [one for one in said if one[2] <= _GONE and one[1].keys() >= _ARM and one[1]["hand"] in self._hands]
