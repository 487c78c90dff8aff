"""Whether another node sends the joint commands that this one would send."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from functools import partial
from typing import Any

from q2r2_control.ros.base_node import STREAM_QOS, BaseNode
from q2r2_control.ros.monitoring.endpoints import node_of


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
