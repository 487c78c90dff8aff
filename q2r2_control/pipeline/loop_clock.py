"""Decide when a tick is due: by the computer's clock, or in simulated time."""

from __future__ import annotations

import time
from dataclasses import replace

from q2r2_control.summary.run_summary import Histogram
from q2r2_control.types import RobotState

_SHORTEST_DT = 1e-6  # Least duration of a tick that :meth:`LoopClock.wait` returns [s].
# Sleeps that are shorter than this are left out [s]. Nobody sees the difference, because a window shows each picture of
# the arms for eight times as long.
_SHORTEST_SLEEP = 0.004
# If simulated time is farther behind the computer's clock than this, it does not catch up [s]. The run goes on in slow
# motion.
_LONGEST_LAG = 0.1
_WINDOW = 1.0  # Time over which late ticks are counted [s].
_MANY_LATE = 0.1  # The loop falls behind if more than this share of the ticks in a window is late.


class WallPace:
    """Lets simulated time pass no faster than the computer's clock, and more slowly if the computer is too slow."""

    def __init__(self) -> None:
        self._wall_at_zero: float | None = None  # Computer's time at simulated time zero [s].

    def wait_for(self, elapsed: float) -> None:
        """Sleep until ``elapsed`` [s] have passed on the computer's clock since simulated time zero."""
        now = time.monotonic()
        if self._wall_at_zero is None:
            self._wall_at_zero = now - elapsed
        ahead = self._wall_at_zero + elapsed - now
        if ahead >= _SHORTEST_SLEEP:
            time.sleep(ahead)
        elif ahead < -_LONGEST_LAG:
            self._wall_at_zero -= ahead + _LONGEST_LAG


class LoopClock:
    """Ticks on a grid of ``period`` [s], in real time or in simulated time. Simulated time is never late.

    Simulated time passes as fast as the ticks are computed, or no faster than ``pace`` allows. The ticks are the same
    in both cases, so that their results are equal, bit for bit.
    """

    def __init__(self, period: float, realtime: bool, pace: WallPace | None = None) -> None:
        self.period, self._realtime, self._pace = period, realtime, pace
        self._ticks = 0
        # Times of the loop's clock: start of the run, newest tick, and when this tick was due [s].
        self.start = self.now = self._due = time.monotonic() if realtime else 0.0
        self._wall_start = time.perf_counter()
        self.lateness = Histogram(1e-3)  # Delay of each tick after it was due.
        self.overruns = 0  # Number of ticks that began more than a period after they were due.
        self._window_ends, self._late_in_window = self.now + _WINDOW, 0
        self.woke = self._wall_start  # Beginning of the newest tick, by time.perf_counter() [s].

    def wait(self) -> float:
        """Wait for the next tick; returns the time since the last tick [s], even if this time is long."""
        self._ticks += 1
        if not self._realtime:
            self.now = self._ticks * self.period
            self.keep_pace()
            return self.period
        self._due += self.period
        rest = self._due - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        before, self.now, self.woke = self.now, time.monotonic(), time.perf_counter()
        late = self.now - self._due
        self.lateness.add(late)
        self.overruns += late > self.period
        self._late_in_window += late > self.period
        # Delays do not add up, because ticks are due on a grid. Ticks that were missed are not repeated later.
        self._due = max(self._due, self.now - self.period)
        return max(self.now - before, _SHORTEST_DT)

    def keep_pace(self) -> None:
        """If simulated time is ahead of the computer's clock and must not pass faster than this clock, wait."""
        if self._pace is not None:
            self._pace.wait_for(self.now - self.start)

    def falls_behind(self) -> bool:
        """Return True once for each second in which more than a tenth of the ticks were late by more than a period."""
        if self.now < self._window_ends:
            return False
        late, self._late_in_window, self._window_ends = self._late_in_window, 0, self.now + _WINDOW
        return late * self.period > _MANY_LATE * _WINDOW

    def after(self, duration: float) -> bool:
        """Return whether the run has lasted ``duration`` [s], or at most half a period less.

        Because of this tolerance, rounding errors cannot add a tick.
        """
        return self.now - self.start >= duration - 0.5 * self.period

    def read(self) -> float:
        """Return the present time [s]; in simulated time the time of the tick."""
        return time.monotonic() if self._realtime else self.now

    def since(self, moment: float) -> float:
        """Return the time from a ``moment`` of time.monotonic() to this tick [s]; 0 in simulated time."""
        return max(self.now - moment, 0.0) if self._realtime else 0.0

    def real_time_factor(self) -> float | None:
        """Return the simulated time per second of the computer's clock [s/s]; None in real time."""
        return None if self._realtime else (self.now - self.start) / max(self.wall_time(), 1e-9)

    def wall_time(self) -> float:
        """Return the real time since the run began [s]."""
        return time.perf_counter() - self._wall_start


class PlantClock:
    """Stamps the states of a plant by the loop's clock.

    If the plant gives the same state again, its age grows by the time for which the plant was advanced since then.
    """

    def __init__(self, state: RobotState) -> None:
        """``state`` is the first state of the plant."""
        # The plant's stamp of the newest state, and the time for which it was advanced without a newer state [s].
        self._stamp, self._unanswered = state.stamp, 0.0

    def give(self, dt: float) -> None:
        """Record that the plant was advanced by ``dt`` [s]."""
        self._unanswered += dt

    def stamped(self, state: RobotState, now: float) -> tuple[RobotState, float]:
        """Return the ``state`` with a stamp of the loop's clock, and the plant's own time since the state before [s].

        Args:
            state: The state that was read at ``now``, with the stamp of the plant's clock.
            now: The time of the loop [s].
        """
        passed = state.stamp - self._stamp
        if passed != 0.0:
            self._stamp, self._unanswered = state.stamp, 0.0
        return replace(state, stamp=now - self._unanswered), passed
