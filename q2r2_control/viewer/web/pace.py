"""The rate at which the browser that drives sends positions, and what to do if it is too low."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

_TOLD = 10.0  # If no position came for too long, the advice is then shown for this time [s].
_CURE = (
    "Let go, then drag again. If it happens often, make the window smaller, close other programs, or open the page on "
    "another computer."
)


class BrowserPace:
    """Measures how often a browser sends positions, and gives advice if it sends them too seldom.

    Arms stop if no position comes for ``allowed`` [s]. ``clock`` returns the time [s].
    """

    def __init__(self, allowed: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._allowed, self._clock = allowed, clock
        self._heard: float | None = None  # Time at which the newest position came [s]; None outside of a drag.
        self._silence, self._ended = 0.0, -math.inf  # The longest recent time without a position, and its end [s].

    def begin(self) -> None:
        """Forget all times, because a drag begins."""
        self._heard, self._silence, self._ended = self._clock(), 0.0, -math.inf

    def note(self) -> None:
        """Note that a position has come."""
        now = self._clock()
        silence = 0.0 if self._heard is None else now - self._heard
        self._heard = now
        if now - self._ended > _TOLD or silence > self._silence:
            self._silence, self._ended = silence, now

    def end(self) -> None:
        """Note that the drag is over, so that no more positions come."""
        self._heard = None

    def advice(self, silent: bool) -> str:
        """Return why positions come too late and what to do; empty if they come in time.

        ``silent`` says whether an arm is lost because its hand's data did not come in time. As long as the arm is lost,
        the advice stays.
        """
        now, allowed = self._clock(), self._allowed
        silence = max(self._silence, 0.0 if self._heard is None else now - self._heard)
        is_recent = now - self._ended < _TOLD or silence > self._silence
        if silence > allowed and (silent or is_recent):
            return (
                f"The browser is too slow: it sent no position for {silence:.2f} s, which is {1.0 / silence:.1f} "
                f"positions a second. Arms stop without at least {1.0 / allowed:.0f} a second. {_CURE}"
            )
        return f"The positions of the dragged tool came too late. {_CURE}" if silent else ""
