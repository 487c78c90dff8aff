"""Even times of ticks that a busy machine runs early or late.

A reference that moves on by the time between two such ticks does so unevenly, and a plant that takes one command after
the other, each for a period of its own, makes a ripple of its speed out of that: a tenth of a millisecond in 4 ms is a
fortieth. So ticks count for even times, each for the one that it is nearest to. A late tick counts for all that were
due, see :mod:`tick_pacer`, and one that comes right after it for nothing.
"""

from __future__ import annotations

import math

from q2r2_control.types import LONGEST_DT

_SHARE = 0.02  # of what the even time is off is made up in a tick


class TickClock:
    """Turns the times at which ticks ran into the times for which they count, all in [s]."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._last = -math.inf

    def at(self, now: float) -> float:
        """The time for which a tick that runs at ``now`` counts: within half a period of it, or again the last one.

        Time begins anew after more than 0.1 s, and where it was set back.
        """
        off = now - self._last - self._period
        if not -2.0 * self._period < off < LONGEST_DT:
            self._last = now
            return now
        missed = round(off / self._period)
        if missed >= 0:
            self._last += (1 + missed) * self._period + _SHARE * (off - missed * self._period)
        return self._last
