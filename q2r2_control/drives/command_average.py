"""Average the reference over the last ticks, so that commands keep the cell's limit of jerk."""

from __future__ import annotations

import math
from bisect import bisect_right

import numpy as np

from q2r2_control.control.cubic import cubic
from q2r2_control.types import Array

_ROUNDING = 1e-9  # Differences of times below this are rounding [s].
_LATE = 1.5  # If a tick lasts more periods than this, the reference itself is commanded at its end.


class CommandAverage:
    """The mean of the references in a window of time. It is commanded instead of the newest reference.

    ``robot/command_average.py`` proves that the mean keeps the limit of jerk if ticks are regular, and that it always
    keeps the other limits and the distances. Ticks may be irregular: the reference between two ticks is computed as a
    cubic. During a tick of more than 1.5 periods, the reference is not known well enough. At the end of such a tick,
    the reference itself is commanded, and the mean begins again from there.
    """

    def __init__(self, window: float, period: float) -> None:
        """Make the average over a ``window`` [s] (see ``average_window``), for ticks of a ``period`` [s]."""
        count = max(math.ceil((window - _ROUNDING) / period), 1)
        self._ages, self._longest = period * np.arange(count), _LATE * period
        self._times: list[float] = []  # Times of the last ticks [s].
        self._path: list[tuple[Array, Array]] = []  # q and v of the reference at each of these times, (nv,) each.
        self.settled = True  # Whether the last command was exactly the newest reference.

    @property
    def delay(self) -> float:
        """How far the mean is behind the newest reference [s]."""
        return 0.5 * float(self._ages[-1])

    def reset(self, q: Array) -> None:
        """Begin again with a reference that has rested at ``q`` (nv,) [rad]."""
        self._times, self._path, self.settled = [0.0], [(q.copy(), np.zeros_like(q))], True

    def update(self, q: Array, v: Array, dt: float) -> tuple[Array, Array]:
        """Return position [rad] and velocity [rad/s] of the mean, ``dt`` [s] after the last tick, (nv,) each."""
        if not self._path or dt > self._longest:
            self.reset(q)
            return q, v
        if dt > 0.0:
            self._times.append(self._times[-1] + dt)
            self._path.append((q, v))
        now = self._times[-1]
        samples = [self._at(now - age) for age in self._ages]
        oldest = bisect_right(self._times, now - self._ages[-1] - _ROUNDING) - 1
        if oldest > 0:  # Older references are not used again. Times restart at 0, since rounding grows with the time.
            self._times = [time - self._times[oldest] for time in self._times[oldest:]]
            del self._path[:oldest]
        self.settled = all((sample[0] == q).all() for sample in samples)
        if self.settled:
            # The reference itself is returned, because by rounding the mean of equal numbers may differ from them.
            return q, v
        mean_q, mean_v = (np.mean([sample[i] for sample in samples], axis=0) for i in (0, 1))
        return mean_q, mean_v

    def _at(self, t: float) -> tuple[Array, Array]:
        """Return position and velocity of the reference at ``t`` [s], on the cubic through both ends of the tick."""
        after = bisect_right(self._times, t + _ROUNDING)
        if after == 0:
            return self._path[0][0], np.zeros_like(self._path[0][1])
        (q, v), start = self._path[after - 1], self._times[after - 1]
        if after == len(self._path) or t - start <= _ROUNDING:
            return q, v
        end, end_v = self._path[after]
        h = self._times[after] - start
        return cubic((t - start) / h, h, (q, end), (v, end_v))
