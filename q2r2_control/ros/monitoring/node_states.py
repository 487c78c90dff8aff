"""What nodes say of themselves on ``~/state``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from q2r2_control.events import ReasonKind
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


_PERIOD = 0.3  # of asking the graph for nodes that report [s]
_DISCOVERY = 2.0  # an arm that is there has said so by then: nodes report twice a second [s]
_SILENT, _GONE = 2.0, 5.0  # without a report [s]
_ARM = {"engaged", "ready", "hand"}  # what an arm's node says


class HandListeners:
    """The nodes that say on ``~/state`` that they follow one of some hands."""

    def __init__(self, node: Node, hands: Sequence[str]) -> None:
        self._states, self._hands = NodeStates(node), hands
        self._began = self._asked_at = 0.0  # [s]

    def look(self) -> None:
        """Ask the graph who reports, now and then."""
        now = time.monotonic()
        if now - self._asked_at >= _PERIOD:
            self._began, self._asked_at = self._began or now, now
            self._states.look()

    def unready(self) -> str | None:
        """One line if some arm cannot be engaged yet, or may be one that has not said so; else None."""
        if time.monotonic() - self._began < _DISCOVERY and any(self.engaged(hand) is None for hand in self._hands):
            return "an arm may be there that has not said yet what it does"
        for name, state, age in self._arms():
            if not state["engaged"] and age > _SILENT:
                return f"{name} is silent for {age:.0f} s"
            if not (state["engaged"] or state["ready"]):
                return f"{name}: {state['message']}"
        return None

    def engaged(self, hand: str) -> bool | None:
        """Whether all arms that follow a hand are engaged; None if no arm follows it."""
        engaged = [state["engaged"] for _, state, _ in self._arms() if state["hand"] == hand]
        return all(engaged) if engaged else None

    def paused_by_a_person(self) -> bool:
        """Whether some arm's ``~/pause`` was called."""
        return any(state.get("last_event_kind") == ReasonKind.PAUSE_SERVICE for _, state, _ in self._arms())

    def _arms(self) -> list[tuple[str, dict[str, Any], float]]:
        """Name, state and age [s] of the arms' nodes that follow these hands."""
        now = time.monotonic()
        said = ((name, state, now - at) for name, (state, at) in self._states.newest.items())
        return [one for one in said if one[2] <= _GONE and one[1].keys() >= _ARM and one[1]["hand"] in self._hands]
