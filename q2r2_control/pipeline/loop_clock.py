"""When a tick is due: by the computer's clock, or in simulated time."""

from __future__ import annotations

import time
from dataclasses import replace

from q2r2_control.summary.run_summary import Histogram
from q2r2_control.types import RobotState

_SHORTEST_DT = 1e-6  # [s]
_SHORTEST_SLEEP = (
    0.004  # A shorter one costs more than it is worth: a picture of the arms lasts eight times as long [s].
)
_LONGEST_LAG = 0.1  # Simulated time that is further behind is not caught up with, but goes on in slow motion [s].
_WINDOW = 1.0  # time over which late ticks are counted [s]
_MANY_LATE = 0.1  # share of the ticks of a window


class WallPace:
    """Lets simulated time pass no faster than the computer's clock, and more slowly where the computer is too slow."""

    def __init__(self) -> None:
        self._ahead_since: float | None = None  # reading of the computer's clock at simulated time zero [s]

    def wait_for(self, elapsed: float) -> None:
        """Sleep until ``elapsed`` [s] of simulated time may be over."""
        now = time.monotonic()
        if self._ahead_since is None:
            self._ahead_since = now - elapsed
        ahead = self._ahead_since + elapsed - now
        if ahead >= _SHORTEST_SLEEP:
            time.sleep(ahead)
        elif ahead < -_LONGEST_LAG:
            self._ahead_since -= ahead + _LONGEST_LAG


class LoopClock:
    """Ticks on a grid of ``period`` [s]: in real time, or in simulated time, which is never late.

    Simulated time passes as fast as the ticks come, or, with a ``pace``, no faster than that allows. A tick does not
    know the difference, so both give the same results to the bit.
    """

    def __init__(self, period: float, realtime: bool, pace: WallPace | None = None) -> None:
        self.period, self._realtime, self._pace = period, realtime, pace
        self._ticks = 0
        self.start = self.now = self._due = time.monotonic() if realtime else 0.0  # [s]
        self._wall_start = time.perf_counter()
        self.lateness = Histogram(1e-3)  # of each tick, after it was due
        self.overruns = 0  # ticks that began more than a period after they were due
        self._window_ends, self._late_in_window = self.now + _WINDOW, 0
        self.woke = self._wall_start  # when the newest tick began, by time.perf_counter() [s]

    def wait(self) -> float:
        """Let the next tick come; returns the time since the last one [s], however long that was."""
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
        # Late wake-ups do not add up, since ticks are due on a grid; ticks that were missed are not made up for.
        self._due = max(self._due, self.now - self.period)
        return max(self.now - before, _SHORTEST_DT)

    def keep_pace(self) -> None:
        """Wait where simulated time is ahead of the computer's clock and shall not be."""
        if self._pace is not None:
            self._pace.wait_for(self.now - self.start)

    def falls_behind(self) -> bool:
        """True once in each second in which more than a tenth of the ticks were late by more than a period."""
        if self.now < self._window_ends:
            return False
        late, self._late_in_window, self._window_ends = self._late_in_window, 0, self.now + _WINDOW
        return late * self.period > _MANY_LATE * _WINDOW

    def after(self, duration: float) -> bool:
        """Whether ``duration`` [s] is over; half a period early, so that rounding adds or loses no tick."""
        return self.now - self.start >= duration - 0.5 * self.period

    def read(self) -> float:
        """Time of this very moment; in simulated time that of the tick [s]."""
        return time.monotonic() if self._realtime else self.now

    def real_time_factor(self) -> float | None:
        """Seconds of simulated time that passed in a second of the computer's clock; None in real time."""
        return None if self._realtime else (self.now - self.start) / max(self.wall_time(), 1e-9)

    def wall_time(self) -> float:
        """Real time since the run began [s]."""
        return time.perf_counter() - self._wall_start


class PlantClock:
    """Stamps a plant's states by the loop's clock; a repeated one is as old as the time that the plant got since."""

    def __init__(self, state: RobotState) -> None:
        """``state``: the first one."""
        self._stamp, self._unanswered = state.stamp, 0.0  # and the time given since it had a newer state [s]

    def give(self, dt: float) -> None:
        """The plant is let go on by ``dt`` [s]."""
        self._unanswered += dt

    def stamped(self, state: RobotState, now: float) -> tuple[RobotState, float]:
        """The ``state`` that came at ``now`` [s], stamped by the loop's clock, and the plant's time since the last."""
        passed = state.stamp - self._stamp
        if passed != 0.0:
            self._stamp, self._unanswered = state.stamp, 0.0
        return replace(state, stamp=now - self._unanswered), passed
