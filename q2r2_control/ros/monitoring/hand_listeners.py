"""Who follows a hand: the arms' nodes that listen to its topics, and what they say of themselves."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from q2r2_control.events import ReasonKind
from q2r2_control.ros.monitoring.endpoints import node_of

_PERIOD = 0.1  # of asking the graph [s]
_DISCOVERY = 1.0  # the graph knows one endpoint of a node before another, by less than this [s]
_SILENT = 2.0  # nodes say what they do twice a second [s]
_STARTING = "has not said yet what it does"


class HandListeners:
    """The nodes that listen to some topics of hands. Those that say on ``~/state`` which hand they follow are arms."""

    def __init__(self, node: Node, topics: Sequence[str]) -> None:
        """``topics``: of buttons."""
        self._node, self._topics = node, topics
        self._asked_at = 0.0
        self._unnamed_since = math.inf  # the graph knows a listener and not its node yet [s]
        self._found: dict[str, float] = {}  # full name of a node -> when it was found [s]
        self._subscriptions: dict[str, Any] = {}
        self._states: dict[str, tuple[dict[str, Any], float]] = {}  # full name -> what it said last, and when [s]

    def look(self) -> None:
        """Ask the graph who listens, now and then."""
        now = time.monotonic()
        if now - self._asked_at < _PERIOD:
            return
        self._asked_at = now
        names = {
            node_of(endpoint)
            for topic in self._topics
            for endpoint in self._node.get_subscriptions_info_by_topic(topic)
        }
        self._unnamed_since = min(self._unnamed_since, now) if None in names else math.inf
        listeners = {name for name in names if name is not None}
        for name in self._found.keys() - listeners:
            del self._found[name]
            self._states.pop(name, None)
            if (subscription := self._subscriptions.pop(name, None)) is not None:
                self._node.destroy_subscription(subscription)
        for name in listeners:
            self._found.setdefault(name, now)
            if name not in self._subscriptions and self._node.count_publishers(f"{name}/state"):
                listen = partial(self._on_state, name)
                self._subscriptions[name] = self._node.create_subscription(String, f"{name}/state", listen, 10)

    def unready(self) -> str | None:
        """One line if some arm cannot be engaged yet, or may be one that has not said so; else None."""
        now = time.monotonic()
        if 0.0 <= now - self._unnamed_since < _SILENT:
            return f"a listener {_STARTING}"
        for name, found in self._found.items():
            state, said = self._states.get(name, ({}, found))
            if not state and now - found < (_SILENT if name in self._subscriptions else _DISCOVERY):
                return f"{name} {_STARTING}"
            if _is_arm(state) and not state["engaged"]:
                if now - said > _SILENT:
                    return f"{name} is silent for {now - said:.0f} s"
                if not state["ready"]:
                    return f"{name}: {state['message']}"
        return None

    def engaged(self, hand: str) -> bool | None:
        """Whether all arms that follow a hand are engaged; None if no arm follows it."""
        arms = [state for state, _ in self._states.values() if _is_arm(state) and state["hand"] == hand]
        return all(state["engaged"] for state in arms) if arms else None

    def paused_by_a_person(self) -> bool:
        """Whether some arm's ``~/pause`` was called."""
        return any(
            _is_arm(state) and state.get("last_event_kind") == ReasonKind.PAUSE_SERVICE
            for state, _ in self._states.values()
        )

    def _on_state(self, name: str, message: String) -> None:
        try:
            state = json.loads(message.data)
        except ValueError:
            return  # some other node's
        if isinstance(state, dict) and name in self._found:
            self._states[name] = state, time.monotonic()


def _is_arm(state: Mapping[str, Any]) -> bool:
    return {"engaged", "ready", "hand", "message", "last_event"} <= state.keys()
