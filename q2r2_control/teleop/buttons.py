"""Presses of a hand's two buttons, distinguished from the headset's alignment chord."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, auto

from q2r2_control.types import HandInputs


class Press(Enum):
    """What a hand's buttons ask for."""

    LOWER_DOWN = auto()  # the lower button went down; it may still become a chord
    UPPER_DOWN = auto()  # the same of the upper one
    LOWER = auto()  # the lower button was pressed, and alone
    UPPER = auto()  # the upper button was pressed, and alone


@dataclass
class _Button:
    """One button's level, and its press while that may still become a chord."""

    down: bool = True  # as held until seen released, so that only a press that was seen from its start counts
    pressed_at: float | None = None  # of the delayed press [s]


@dataclass
class ButtonArbiter:
    """Turns levels into presses, each reported once.

    The two buttons of a chord never go down in the same sample, so a press is delayed by ``chord_window`` [s] (or until
    release, if that is earlier): when the other button follows, it was a chord and neither press is reported. Only
    stopping must not wait: ``LOWER_DOWN`` and ``UPPER_DOWN`` report a button at once, and may only be used to stop
    motion, which a chord does as well. A button that goes down while the other one is held makes a chord at any time.

    After a chord both buttons have to be released before either counts again.
    """

    chord_window: float
    chord: bool = False  # both buttons were pressed together, and not all released since
    _upper: _Button = field(default_factory=_Button)
    _lower: _Button = field(default_factory=_Button)
    _stamp: float = -math.inf

    def cancel(self) -> None:
        """Drop delayed presses; a button that is held has to be released before it counts again."""
        self._upper.pressed_at = self._lower.pressed_at = None

    def forget(self) -> None:
        """Drop delayed presses and treat both buttons as held until they are seen released."""
        self.chord = False
        self._upper, self._lower, self._stamp = _Button(), _Button(), -math.inf

    def stale(self, now: float, timeout: float) -> bool:
        """Whether no inputs were received for ``timeout`` [s]: the operator could not stop the arm by a button."""
        return now - self._stamp > timeout

    def receive(self, inputs: HandInputs, stamp: float, now: float) -> list[Press]:
        """Process one reading received at ``stamp`` [s]; one that is older than the last is ignored."""
        stamp = min(stamp, now)
        if not self._stamp <= stamp or stamp == -math.inf:
            return []
        self._stamp = stamp
        upper, lower = bool(inputs.button_upper), bool(inputs.button_lower)
        presses = self._released(upper, lower)
        rose_upper, rose_lower = upper and not self._upper.down, lower and not self._lower.down
        self._upper.down, self._lower.down = upper, lower
        if self.chord:
            self.chord = upper or lower
        elif upper and lower and (rose_upper or rose_lower):
            self.chord = True
            self.cancel()
        elif rose_upper:
            self._upper.pressed_at = stamp
            presses.append(Press.UPPER_DOWN)
        elif rose_lower:
            self._lower.pressed_at = stamp
            presses.append(Press.LOWER_DOWN)
        return presses

    def due(self, now: float) -> list[Press]:
        """Presses whose window has passed without a chord."""
        presses = []
        for button, press in ((self._upper, Press.UPPER), (self._lower, Press.LOWER)):
            if button.pressed_at is not None and now - button.pressed_at >= self.chord_window:
                button.pressed_at = None
                presses.append(press)
        return presses

    def _released(self, upper: bool, lower: bool) -> list[Press]:
        """Presses that end by release; no chord can follow."""
        presses = []
        for button, held, press in ((self._upper, upper, Press.UPPER), (self._lower, lower, Press.LOWER)):
            if button.pressed_at is not None and not held:
                button.pressed_at = None
                presses.append(press)
        return presses
