"""What tests of nodes wait for, far longer than it takes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from queue import Empty, Queue
from typing import Any

from tests.ros.processes import PATIENCE


def eventually(condition: Callable[[], object], what: str) -> None:
    """Wait until ``condition`` holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, f"never happened: {what}"
        time.sleep(0.01)


def drained(queue: Queue[Any]) -> list[Any]:
    """All that waits in ``queue``."""
    items = []
    while True:
        try:
            items.append(queue.get_nowait())
        except Empty:
            return items


class States:
    """Listens to a node's ``~/state``."""

    def __init__(self, node: Any, name: str) -> None:
        from std_msgs.msg import String

        self._states: Queue[Any] = Queue()
        node.create_subscription(String, f"/{name}/state", self._states.put, 10)

    def wait_for(self, text: str) -> dict[str, Any]:
        """The first state from now on whose message contains ``text``."""
        drained(self._states)
        deadline = time.monotonic() + PATIENCE
        while True:
            state: dict[str, Any] = json.loads(self._states.get(timeout=PATIENCE).data)
            if text in state["message"]:
                return state
            assert time.monotonic() < deadline, f"no state with {text!r}, the last was {state}"
