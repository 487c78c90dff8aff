"""Even times of ticks that a busy machine runs some tenths of a millisecond early or late.

A reference that moves on by the time between two such ticks does so unevenly, and a plant that takes one command after
the other, each for a period of its own, makes a ripple of its speed out of that: a tenth of a millisecond in 4 ms is a
fortieth. So ticks count as even until they are half a period off; a tick that is later than that is a late one, see
:mod:`tick_pacer`.
"""

from __future__ import annotations

import math

_SHARE = 0.02  # of what the even time is off is made up in a tick


class TickClock:
    """Turns the times at which ticks ran into the times for which they count, all in [s]."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._last = -math.inf

    def at(self, now: float) -> float:
        """The time for which a tick that runs at ``now`` counts: within half a period of it."""
        expected = self._last + self._period
        off = now - expected
        self._last = expected + _SHARE * off if abs(off) < 0.5 * self._period else now
        return self._last
