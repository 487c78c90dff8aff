"""Converts times of the computer's clock, by which cameras stamp their pictures, into times of the loop's clock."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

_KEPT = 8192  # Number of ticks whose times are kept: 8 s of a loop at 1 kHz.


class TickTime(NamedTuple):
    computer: float  # By the monotonic clock [s].
    loop: float  # By the loop's clock [s].
    number: int  # Number of the last tick up to this time.


class LoopTimes:
    """Converts times of the computer's monotonic clock into times of the loop's clock.

    In real time, both clocks are the same. In simulated time, the loop's clock may be slower than the computer's clock,
    even if the loop is paced. Its ticks then come in bursts.
    """

    def __init__(self) -> None:
        self._ticks: deque[TickTime] = deque(maxlen=_KEPT)

    def add(self, tick: TickTime) -> None:
        self._ticks.append(tick)

    def at(self, computer: float) -> TickTime:
        """Return the loop's time at the time ``computer`` of the computer's clock, and the number of the last tick.

        The last tick is the newest tick that began at ``computer`` or earlier.

        Before the first tick, the loop's clock is assumed to run like the computer's clock. The number is then the
        number of the first tick.
        """
        ahead = None
        for tick in reversed(self._ticks):
            if tick.computer <= computer:
                passed = computer - tick.computer
                longest = passed if ahead is None else ahead.loop - tick.loop
                return TickTime(computer, tick.loop + min(passed, longest), tick.number)
            ahead = tick
        first = self._ticks[0]
        return TickTime(computer, first.loop - (first.computer - computer), first.number)
