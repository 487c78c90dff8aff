"""A gripper that closes as far as a trigger is pressed."""

from __future__ import annotations

import math

from q2r2_control.config.bindings import Action, BindingSettings
from q2r2_control.teleop.gestures import travel
from q2r2_control.types import HandInputs

_SLACK = 0.05  # of a trigger's way at both ends, which not every controller reaches
_HYSTERESIS = 0.02  # a trigger that trembles by less moves nothing
_PICK_UP = 0.05  # how near the trigger has to come to the gripper


class AnalogGripper:
    """The opening that a trigger asks for, 0 closed .. 1 fully open.

    After a new connection, another stance or a stop, the trigger moves nothing until it has come to where the gripper
    is, or past it: a gripper that holds something does not open because nobody presses yet.
    """

    def __init__(self, bindings: BindingSettings, speed: float) -> None:
        """``speed``: greatest, in openings a second."""
        bound = (binding.control for binding in bindings.bound() if binding.action is Action.GRIPPER_ANALOG)
        self._control = next(bound, None)
        self._speed = speed
        self._at = -math.inf
        self.forget()

    def forget(self) -> None:
        """The trigger has to come to where the gripper is before it counts."""
        self._wanted: float | None = None
        self._picked_up = False

    def receive(self, inputs: HandInputs, opening: float) -> None:
        """Process a new reading while the gripper is commanded to ``opening``."""
        if self._control is None or not math.isfinite(value := travel(self._control, inputs)):
            return
        wanted = 1.0 - min(max((value - _SLACK) / (1.0 - 2.0 * _SLACK), 0.0), 1.0)
        before = wanted if self._wanted is None else self._wanted
        if not self._picked_up:
            self._picked_up = min(before, wanted) - _PICK_UP <= opening <= max(before, wanted) + _PICK_UP
            self._wanted = wanted
        elif abs(wanted - before) >= _HYSTERESIS or wanted in (0.0, 1.0):
            self._wanted = wanted

    def opening(self, opening: float, now: float) -> float:
        """The opening at ``now`` [s] of a gripper that was commanded to ``opening`` at the last call."""
        passed, self._at = now - self._at, now
        if self._wanted is None or not self._picked_up or not math.isfinite(passed):
            return opening
        step = self._speed * max(passed, 0.0)
        return opening + min(max(self._wanted - opening, -step), step)
