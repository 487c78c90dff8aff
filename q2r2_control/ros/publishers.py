"""Which nodes a topic's data come from: asked of the graph now and then, and remembered for when they cease."""

from __future__ import annotations

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

_PERIOD = 1.0  # between two looks; a node that dies stays in the graph for longer than that [s]
_UNKNOWN = "_NODE_NAME_UNKNOWN_"  # until discovery has come that far


class Publishers:
    """Names of the nodes that publish any of ``topics``, or did until nobody was left."""

    def __init__(self, node: Node, *topics: str) -> None:
        self._node, self._topics = node, topics
        self._names: list[str] = []
        node.create_timer(_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def __str__(self) -> str:
        """Their full names, "nobody" where there never was one."""
        if not self._names:
            self._look()
        return " and ".join(self._names) or "nobody"

    def _look(self) -> None:
        names = {
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for topic in self._topics
            for info in self._node.get_publishers_info_by_topic(topic)
            if info.node_name != _UNKNOWN
        }
        self._names = sorted(names) or self._names
