"""The arms that follow a hand, by what their nodes say of themselves."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from q2r2_control.events import ReasonKind

_PERIOD = 0.3  # of asking the graph for nodes that report [s]
_DISCOVERY = 2.0  # an arm that is there has said so by then: nodes report twice a second [s]
_SILENT, _GONE = 2.0, 5.0  # without a report [s]


class HandListeners:
    """The nodes that say on ``~/state`` that they follow one of some hands."""

    def __init__(self, node: Node, hands: Sequence[str]) -> None:
        self._node, self._hands = node, hands
        self._began = self._asked_at = 0.0  # [s]
        self._heard: set[str] = set()  # topics
        self._states: dict[str, tuple[dict[str, Any], float]] = {}  # topic -> what an arm said last, and when [s]

    def look(self) -> None:
        """Ask the graph who reports, now and then."""
        now = time.monotonic()
        if now - self._asked_at < _PERIOD:
            return
        self._began, self._asked_at = self._began or now, now
        for topic, types in self._node.get_topic_names_and_types():
            if topic.endswith("/state") and types == ["std_msgs/msg/String"] and topic not in self._heard:
                self._heard.add(topic)
                self._node.create_subscription(String, topic, partial(self._on_state, topic), 10)

    def unready(self) -> str | None:
        """One line if some arm cannot be engaged yet, or may be one that has not said so; else None."""
        now = time.monotonic()
        if now - self._began < _DISCOVERY and any(self.engaged(hand) is None for hand in self._hands):
            return "an arm may be there that has not said yet what it does"
        for topic, (state, said) in self._states.items():
            if state["engaged"] or now - said > _GONE:
                continue
            name = topic.removesuffix("/state")
            if now - said > _SILENT:
                return f"{name} is silent for {now - said:.0f} s"
            if not state["ready"]:
                return f"{name}: {state['message']}"
        return None

    def engaged(self, hand: str) -> bool | None:
        """Whether all arms that follow a hand are engaged; None if no arm follows it."""
        now = time.monotonic()
        arms = [state for state, said in self._states.values() if state["hand"] == hand and now - said <= _GONE]
        return all(state["engaged"] for state in arms) if arms else None

    def paused_by_a_person(self) -> bool:
        """Whether some arm's ``~/pause`` was called."""
        return any(state.get("last_event_kind") == ReasonKind.PAUSE_SERVICE for state, _ in self._states.values())

    def _on_state(self, topic: str, message: String) -> None:
        try:
            state = json.loads(message.data)
        except ValueError:
            return  # some other node's
        is_arm = isinstance(state, dict) and {"engaged", "ready", "hand", "message", "last_event"} <= state.keys()
        if is_arm and state["hand"] in self._hands:
            self._states[topic] = state, time.monotonic()
        else:
            self._states.pop(topic, None)
