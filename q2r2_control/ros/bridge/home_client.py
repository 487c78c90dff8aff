"""The way home that the teleoperation asks the built-in controller for, or sees it go because another one has asked."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.teleop.teleop import Teleop

_PATIENCE = 2.0  # with an answer, and until the controller says that it is on its way [s]


class HomeClient:
    """Calls ``~/home`` and ``~/hold`` of the controller as the teleop layer's state says; never waits."""

    def __init__(self, node: Node, controller: str | None) -> None:
        """``controller``: the built-in one's name; None: the arms' controller has no way home."""
        self._name = controller
        self._home: Any = None if controller is None else node.create_client(Trigger, f"{controller}/home")
        self._hold: Any = None if controller is None else node.create_client(Trigger, f"{controller}/hold")
        self._answer: Any = None  # future; None: the service was not called
        self._since: float | None = None  # of a way home: asked for, or accepted [s]; None: there is none
        self._said = self._seen = False  # that it goes home, now and on this way

    def update(self, teleop: Teleop, said: bool, outcome: str, now: float) -> None:
        """Once a tick; ``said``: whether the controller says that it goes home, ``outcome``: how the last way ended."""
        asked, begins, self._said = teleop.homing, said and not self._said, said
        if self._since is None and begins and not asked:  # whoever has called the service
            teleop.home(now)
            if teleop.homing:
                self._answer, self._since, self._seen = None, now, True
            else:
                self._call_hold()
        elif self._since is None and asked:
            self._call_home(teleop, now)
        elif self._since is not None and not asked:
            self._since = None
            self._call_hold()
        elif self._since is not None:
            self._watch(teleop, outcome, now)

    def _watch(self, teleop: Teleop, outcome: str, now: float) -> None:
        """End the way home if it is over, or the controller does not go."""
        self._seen |= self._said
        accepted = self._answer is None or (self._answer.done() and self._answer.result().success)
        late = self._since is not None and now - self._since > _PATIENCE
        if self._seen:
            if not self._said:
                self._end(teleop, now, outcome or f"{self._name} ended the way home", arrived=bool(outcome))
        elif accepted and late:
            self._end(teleop, now, outcome or f"{self._name} did not begin", arrived=bool(outcome))
        elif not accepted and self._answer.done():
            self._end(teleop, now, self._answer.result().message)
        elif late:
            self._home.remove_pending_request(self._answer)
            self._end(teleop, now, f"{self._name}/home does not answer")

    def _call_home(self, teleop: Teleop, now: float) -> None:
        if self._home is None:
            self._end(teleop, now, "this arm's controller has no way home")
        elif not self._home.service_is_ready():
            self._end(teleop, now, f"there is no service {self._name}/home")
        else:
            self._since, self._seen = now, False
            self._answer = self._home.call_async(Trigger.Request())

    def _call_hold(self) -> None:
        if self._hold is not None:
            self._hold.call_async(Trigger.Request())

    def _end(self, teleop: Teleop, now: float, outcome: str, arrived: bool = False) -> None:
        self._since = self._answer = None
        reason = Reason.in_words(outcome)
        teleop.end_homing(now, reason if arrived else Reason(ReasonKind.NOT_HOMING, cause=reason), arrived)
