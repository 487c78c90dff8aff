"""MoveIt Servo takes poses only after its service ``switch_command_type`` was told so, at each of its starts."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from q2r2_control.ros.bridge.base_node import BaseNode

_POSE = 2  # of moveit_msgs/srv/ServoCommandType
_PATIENCE = 1.0  # for an answer, before asking again [s]


class CommandType:
    """Asks for poses until the service agrees, again whenever its node has come anew; nothing here waits.

    Without moveit_msgs it cannot ask: ``advice`` says so, and engaging is then the user's to decide.
    """

    def __init__(self, node: BaseNode, service: str) -> None:
        self._service, self._client = service, None
        self.advice: str | None = None
        try:
            self._kind: Any = import_module("moveit_msgs.srv").ServoCommandType
        except ImportError:
            self.advice = f"moveit_msgs cannot be imported: call {service} with {_POSE} yourself"
            return
        self._client = node.create_client(self._kind, service)
        self._lives, self._agreed = -1, False
        self._asked = float("-inf")
        self._answer: Any = None  # future

    @property
    def unready(self) -> str | None:
        """Why poses do not count yet."""
        if self._client is None or self._agreed:
            return None
        return f"{self._service} has not agreed to poses yet"

    def step(self, lives: int, now: float) -> None:
        """Ask where that is due; ``lives``: how often the controller was seen to come."""
        if self._client is None:
            return
        if lives != self._lives:
            self._lives, self._agreed, self._asked = lives, False, float("-inf")
            self._forget()
        if self._answer is not None and self._answer.done():
            self._agreed = bool(self._answer.result().success)
            self._answer = None
        if not self._agreed and now - self._asked > _PATIENCE and self._client.service_is_ready():
            self._forget()
            self._asked = now
            self._answer = self._client.call_async(self._kind.Request(command_type=_POSE))

    def _forget(self) -> None:
        """An answer that is late is one of the past."""
        if self._answer is not None and self._client is not None:
            self._client.remove_pending_request(self._answer)
        self._answer = None
