"""Waiting for nodes: for a condition, a state that a node reports, or the answer of a service."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from queue import Empty, Queue
from typing import Any

from tests.ros.processes import PATIENCE


def wait_until(
    condition: Callable[[], object],
    what: str,
    details: Callable[[], object] | None = None,
    patience: float = PATIENCE,
) -> None:
    """Wait until ``condition`` holds; fails with ``what`` and ``details`` after a time far longer than it takes."""
    deadline = time.monotonic() + patience
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {patience:g} s: {what}" + (f"; {details()}" if details else ""))
        time.sleep(0.002)


def call(node: Any, service: str, request: Any = None) -> Any:
    """The response of a Trigger service, or of a SetBool one for its ``request``; another thread spins ``node``."""
    from std_srvs.srv import SetBool, Trigger

    client = node.create_client(Trigger if request is None else SetBool, service)
    try:
        wait_until(client.service_is_ready, f"{service} is there")
        future = client.call_async(Trigger.Request() if request is None else request)
        wait_until(future.done, f"{service} answers")
        return future.result()
    finally:
        node.destroy_client(client)


def drained(queue: Queue[Any]) -> list[Any]:
    """All that is in ``queue``."""
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
