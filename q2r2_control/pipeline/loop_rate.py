"""Choose the rate at which a loop in real time should tick on this computer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from q2r2_control.config.cell import HIGHEST_FITTING_RATE_HZ

# The highest rate that leaves enough time free is chosen. The torques of the impedance are stable even at the lowest
# rate.
FITTING_RATES_HZ = (HIGHEST_FITTING_RATE_HZ, 500.0, 250.0)
_FREE_SHARE = 0.4  # 99 of 100 ticks must leave this share of the period free for other programs.
_WARM_UP, _TIMED = 50, 250  # Number of first ticks that are ignored, and number of timed ticks after them.


@dataclass(frozen=True, slots=True)
class RateFit:
    """A rate of the loop, and the duration of its ticks on this computer."""

    rate_hz: float
    p99_s: float  # Duration that 99 of 100 ticks do not exceed.

    @property
    def leaves_room(self) -> bool:
        """Whether 99 of 100 ticks leave 40 % of the period free."""
        return self.p99_s * self.rate_hz <= 1.0 - _FREE_SHARE

    def __str__(self) -> str:
        used = f"99 of 100 ticks take at most {1e6 * self.p99_s:.0f} us, {100 * self.p99_s * self.rate_hz:.0f} %"
        if self.leaves_room:
            return f"loop rate {self.rate_hz:.0f} Hz: {used} of the period (loop_rate_hz: auto)"
        allowed = f"{1e6 * (1.0 - _FREE_SHARE) / self.rate_hz:.0f} us"
        late = f"ticks may come late, since only {allowed} would leave time for other programs; close some"
        return f"loop rate {self.rate_hz:.0f} Hz, the lowest: {used} of the period: {late}"


def largest_usual_time(durations_s: Iterator[float]) -> float:
    """Return the duration that 99 of 100 ticks do not exceed [s], without the first ticks."""
    return float(np.percentile(list(islice(durations_s, _WARM_UP, _WARM_UP + _TIMED)), 99))
