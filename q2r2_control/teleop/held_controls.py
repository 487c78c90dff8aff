"""Which of a hand's triggers and stick directions are held, and what that means."""

from __future__ import annotations

import math

from q2r2_control.config.bindings import LASTING, Action, BindingSettings
from q2r2_control.types import HandInputs

# A control is held from the first of these on and let go below the second, so that noise in between changes nothing.
_HELD, _LET_GO = 0.6, 0.4


def travel(control: str, inputs: HandInputs) -> float:
    """How far a control is pressed or pushed, 0 at rest and 1 at its end."""
    match control:
        case "trigger":
            return inputs.press_index
        case "grip":
            return inputs.press_middle
        case "stick_up":
            return inputs.thumb_stick_vertical
        case "stick_down":
            return -inputs.thumb_stick_vertical
        case "stick_right":
            return inputs.thumb_stick_horizontal
    return -inputs.thumb_stick_horizontal


def is_held(control: str, inputs: HandInputs, was_held: bool) -> bool:
    """Whether a button is down, or a trigger or stick far enough from rest; what is not a number is let go."""
    match control:
        case "lower":
            return bool(inputs.button_lower)
        case "upper":
            return bool(inputs.button_upper)
    return travel(control, inputs) >= (_LET_GO if was_held else _HELD)


class HeldControls:
    """The actions of one hand that are held.

    A control counts as held only once it was seen let go, so that one that is held while the connection comes up, or
    was lost, does nothing. A reading that is not a number lets go.
    """

    def __init__(self, bindings: BindingSettings) -> None:
        self._controls = [
            (binding.control, binding.action)
            for binding in bindings.bound()
            if binding.action in LASTING and binding.action is not Action.GRIPPER_ANALOG
        ]
        self.actions: frozenset[Action] = frozenset()
        self.forget()

    def forget(self) -> None:
        """Nothing is held, and what is has to be let go before it counts."""
        self._seen_let_go: set[str] = set()
        self._stamp = -math.inf
        self.actions = frozenset()

    def receive(self, inputs: HandInputs, stamp: float, now: float) -> None:
        """Process one reading received at ``stamp`` [s]; one that is older than the last is ignored."""
        stamp = min(stamp, now)
        if not self._stamp <= stamp or stamp == -math.inf:
            return
        self._stamp = stamp
        held = set()
        for control, action in self._controls:
            if not is_held(control, inputs, action in self.actions):
                self._seen_let_go.add(control)
            elif control in self._seen_let_go:
                held.add(action)
        self.actions = frozenset(held)
