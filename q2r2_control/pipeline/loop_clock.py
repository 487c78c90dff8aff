"""When a tick is due: by the computer's clock, or in simulated time."""

from __future__ import annotations

import time
from dataclasses import replace

from q2r2_control.summary.run_summary import Histogram
from q2r2_control.types import RobotState

_SHORTEST_DT = 1e-6  # [s]


class LoopClock:
    """Ticks on a grid of ``period`` [s], in real time or as fast as they come, which is never late."""

    def __init__(self, period: float, realtime: bool) -> None:
        self.period, self._realtime = period, realtime
        self._ticks = 0
        self.start = self.now = self._due = time.monotonic() if realtime else 0.0  # [s]
        self._wall_start = time.perf_counter()
        self.lateness = Histogram(1e-3)  # of each tick, after it was due
        self.overruns = 0  # ticks that began more than a period after they were due

    def wait(self) -> float:
        """Let the next tick come; returns the time since the last one [s], however long that was."""
        self._ticks += 1
        if not self._realtime:
            self.now = self._ticks * self.period
            return self.period
        self._due += self.period
        rest = self._due - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)
        before, self.now = self.now, time.monotonic()
        late = self.now - self._due
        self.lateness.add(late)
        self.overruns += late > self.period
        # Late wake-ups do not add up, since ticks are due on a grid; ticks that were missed are not made up for.
        self._due = max(self._due, self.now - self.period)
        return max(self.now - before, _SHORTEST_DT)

    def after(self, duration: float) -> bool:
        """Whether ``duration`` [s] is over; half a period early, so that rounding adds or loses no tick."""
        return self.now - self.start >= duration - 0.5 * self.period

    def read(self) -> float:
        """Time of this very moment; in simulated time that of the tick [s]."""
        return time.monotonic() if self._realtime else self.now

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
