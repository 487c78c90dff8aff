"""Listen only to the reports of a set's nodes on ``~/state``, so that the listener does not change what the set does.

An arm's node would mistake a listener to its targets for a controller, and would let the arm be engaged. A controller
stops commanding arms whose commands get a new receiver. Therefore each sender counts its messages, and reports the
number.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from q2r2_control.config.cell import Config
from q2r2_control.errors import Q2R2Error
from q2r2_control.ros.launch.middleware import set_up_middleware
from q2r2_control.ros.monitoring import NodeStates, node_of
from q2r2_control.ros.watching.lbr_drivers import DriverListener
from q2r2_control.ros.watching.set_view import NodeView, SetView, TopicView, arm_views

_LOOK_PERIOD = 0.5  # Time between two queries of the graph [s].
_OWN = ("/rosout", "/parameter_events")  # Topics of every node.
_COUNTS = 8  # Number of a sender's counts from which its rate is computed.


class WatchError(Q2R2Error):
    """The middleware does not start. The message says why."""


class SetListener:
    """Queries the graph of one domain, and listens to reports on ``~/state``. ``node`` has to be spun."""

    def __init__(self, node: Node, cell: Config, drivers: bool = False) -> None:
        self._node, self._cell = node, cell
        self._drivers = DriverListener(node, cell) if drivers else None
        self._states = NodeStates(node, self._note)
        # By node and topic, the newest counts of messages that the node has reported, each after its time [s].
        self._sent: dict[tuple[str, str], deque[tuple[float, int]]] = {}
        self._topics: dict[str, tuple[str, ...]] = {}  # The types by topic.
        self._publishers: dict[str, tuple[str, ...]] = {}
        self._subscribers: dict[str, tuple[str, ...]] = {}
        self._names: tuple[str, ...] = ()

    def look(self) -> None:
        node, own = self._node, self._node.get_fully_qualified_name()
        self._topics = {name: tuple(types) for name, types in node.get_topic_names_and_types()}
        for topic in self._topics:
            self._publishers[topic] = _names(node.get_publishers_info_by_topic(topic), own)
            self._subscribers[topic] = _names(node.get_subscriptions_info_by_topic(topic), own)
        self._states.look()
        if self._drivers is not None:
            self._drivers.look()
        found = (f"{space.rstrip('/')}/{name}" for name, space in node.get_node_names_and_namespaces())
        self._names = tuple(sorted(name for name in found if name != own))

    def view(self) -> SetView:
        nodes = node_views(self._states)
        members = {node.name for node in nodes}
        topics = tuple(
            TopicView(name, types, self._publishers[name], self._subscribers[name], self._rate(name))
            for name, types in sorted(self._topics.items())
            if self._is_shown(name, members)
        )
        drivers = () if self._drivers is None else tuple(self._drivers.views)
        return SetView(nodes, topics, self._names, arm_views(nodes, self._cell), drivers)

    def _note(self, name: str, state: dict[str, Any]) -> None:
        sent = state.get("sent")
        for topic, count in sent.items() if isinstance(sent, dict) else ():
            if isinstance(count, int):
                self._sent.setdefault((name, topic), deque(maxlen=_COUNTS)).append((time.monotonic(), count))

    def _rate(self, topic: str) -> float | None:
        """Return the sum of the rates of all nodes that count their messages on a topic [Hz]; None without counts."""
        rates = []
        for name in self._publishers[topic]:
            counts = self._sent.get((name, topic))
            if counts is not None and len(counts) > 1:
                (began, first), (ended, last) = counts[0], counts[-1]
                rates.append(max(last - first, 0) / max(ended - began, 1e-9))
        return sum(rates) if rates else None

    def _is_shown(self, topic: str, members: set[str]) -> bool:
        """Return whether a node of the set expects messages on the topic, or sends messages on it.

        A topic that is sent is shown only if its sender counts the messages, or if somebody receives them.
        """
        if topic in _OWN or "/_action/" in topic or topic.removesuffix("/state") in members:
            return False
        if members.intersection(self._publishers[topic]):
            counted = any(topic == told for _, told in self._sent)
            return bool(counted or self._subscribers[topic])
        receivers = [self._states.newest[name][0] for name in members.intersection(self._subscribers[topic])]
        # Arms and controllers need all topics that they receive. A robot receives only one of many kinds of commands.
        return any(self._publishers[topic] or "arm" in state or "phase" in state for state in receivers)


def node_views(states: NodeStates) -> tuple[NodeView, ...]:
    now = time.monotonic()
    return tuple(
        NodeView(name, state["level"], state["message"], now - at, state)
        for name, (state, at) in sorted(states.newest.items())
    )


def watch_set(
    cell: Config,
    duration: float | None,
    show: Callable[[SetView], None],
    stop: Callable[[], bool],
    drivers: bool = False,
) -> SetView:
    """Listen for ``duration`` [s] or until ``stop``, and return the last view; raises :class:`WatchError`.

    ``show`` gets all earlier views. With ``drivers``, KUKA drivers are listened to as well.
    """
    set_up_middleware(os.environ)
    try:
        rclpy.init(args=[], signal_handler_options=rclpy.SignalHandlerOptions.NO)
    except (rclpy_implementation.RCLError, RuntimeError) as error:
        raise WatchError(f"ROS does not start: {error}") from None
    try:
        node = Node(f"q2r2_watch_{os.getpid()}", enable_rosout=False, start_parameter_services=False)
        listener, executor = SetListener(node, cell, drivers), SingleThreadedExecutor()
        try:
            executor.add_node(node)
            begin = looked = time.monotonic()
            listener.look()
            while not stop() and (duration is None or time.monotonic() - begin < duration):
                executor.spin_once(timeout_sec=0.1)
                if time.monotonic() - looked >= _LOOK_PERIOD:
                    looked = time.monotonic()
                    listener.look()
                    show(listener.view())
            listener.look()
            return listener.view()
        finally:
            # Without this call, Python would destroy the executor's parts in any order. rclpy would print a traceback.
            executor.shutdown()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _names(endpoints: list[Any], own: str) -> tuple[str, ...]:
    names = (node_of(endpoint) or "a node not known yet" for endpoint in endpoints)
    return tuple(sorted(name for name in names if name != own))
