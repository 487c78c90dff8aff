"""The way home that an arm's node asks the built-in controller for, or sees it go because another one has asked."""

from __future__ import annotations

from enum import Enum, auto
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.teleop.teleop import Teleop

_PATIENCE = 2.0  # with an answer, and until the controller says that it is on its way [s]


class _Phase(Enum):
    NONE = auto()
    ASKED = auto()
    ACCEPTED = auto()  # and not said yet that the arms are on their way
    UNDER_WAY = auto()


class HomeClient:
    """Calls ``~/home`` and ``~/hold`` of the controller as the teleop layer's state says; never waits."""

    def __init__(self, node: Node, controller: str | None) -> None:
        """``controller``: the built-in one's name; None: the arm's controller has no way home."""
        self._name = controller
        self._home: Any = None if controller is None else node.create_client(Trigger, f"{controller}/home")
        self._hold: Any = None if controller is None else node.create_client(Trigger, f"{controller}/hold")
        self._phase, self._since, self._said = _Phase.NONE, 0.0, False
        self._answer: Any = None

    def update(self, teleop: Teleop, said: bool, outcome: str, now: float) -> None:
        """Once a tick; ``said``: whether the controller says that it goes home, ``outcome``: how the last way ended."""
        asked, begins, self._said = teleop.homing, said and not self._said, said
        if self._phase is _Phase.NONE:
            if asked:
                self._ask(teleop, now)
            elif begins:  # the other arm's hand asked, or whoever called the service
                teleop.home(now)
                if teleop.homing:
                    self._phase = _Phase.UNDER_WAY
                else:
                    self._ask_to_hold()
        elif not asked:
            self._phase = _Phase.NONE
            self._ask_to_hold()
        elif said:
            self._phase = _Phase.UNDER_WAY
        elif self._phase is _Phase.UNDER_WAY:
            self._end(teleop, now, outcome or f"{self._name} ended the way home", arrived=bool(outcome))
        elif self._phase is _Phase.ASKED:
            self._take_answer(teleop, now)
        elif now - self._since > _PATIENCE:
            self._end(teleop, now, outcome or f"{self._name} did not begin", arrived=bool(outcome))

    def _ask_to_hold(self) -> None:
        if self._hold is not None:
            self._hold.call_async(Trigger.Request())

    def _ask(self, teleop: Teleop, now: float) -> None:
        if self._home is None:
            self._end(teleop, now, "this arm's controller has no way home", arrived=False)
        elif not self._home.service_is_ready():
            self._end(teleop, now, f"there is no service {self._name}/home", arrived=False)
        else:
            self._phase, self._since = _Phase.ASKED, now
            self._answer = self._home.call_async(Trigger.Request())

    def _take_answer(self, teleop: Teleop, now: float) -> None:
        if self._answer.done():
            answer = self._answer.result()
            if answer.success:
                self._phase, self._since = _Phase.ACCEPTED, now
            else:
                self._end(teleop, now, f"{answer.message}", arrived=False)
        elif now - self._since > _PATIENCE:
            self._home.remove_pending_request(self._answer)
            self._end(teleop, now, f"{self._name}/home does not answer", arrived=False)

    def _end(self, teleop: Teleop, now: float, outcome: str, arrived: bool) -> None:
        self._phase, self._answer = _Phase.NONE, None
        reason = Reason.of(ReasonKind.OTHER, text=outcome)
        teleop.end_homing(now, reason if arrived else Reason(ReasonKind.NOT_HOMING, cause=reason), arrived)
