"""What nodes say of themselves on ``~/state``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from q2r2_control.ros.base_node import STREAM_QOS

_STATE = "/state"


class NodeStates:
    """The newest state of every node in the domain that reports one, by its full name; the node has to be spun."""

    def __init__(self, node: Node, on_state: Callable[[str, dict[str, Any]], None] | None = None) -> None:
        """``on_state`` gets each name and state."""
        self._node, self._on_state = node, on_state
        self._heard: set[str] = set()  # topics
        self.newest: dict[str, tuple[dict[str, Any], float]] = {}  # and when it came [s]

    def look(self) -> None:
        """Listen to what has appeared in the graph."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic.endswith(_STATE) and types == ["std_msgs/msg/String"] and topic not in self._heard:
                self._heard.add(topic)
                take = partial(self._take, topic.removesuffix(_STATE))
                self._node.create_subscription(String, topic, take, STREAM_QOS)

    def _take(self, name: str, message: String) -> None:
        try:
            state = json.loads(message.data)
        except ValueError:
            return  # some other node's
        if isinstance(state, dict) and {"level", "message"} <= state.keys():
            self.newest[name] = state, time.monotonic()
            if self._on_state is not None:
                self._on_state(name, state)
