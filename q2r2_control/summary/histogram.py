"""Percentiles of durations, of any number of them in constant memory."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np

_BINS = 100_000


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Of a duration; p50 and p99 to one part in a thousand of the histogram's unit, None: nothing was measured."""

    p50: float | None
    p99: float | None
    max: float | None


NOTHING_MEASURED = Percentiles(None, None, None)


class Histogram:
    """Counts durations in thousandths of ``unit`` [s], up to 100 units."""

    def __init__(self, unit: float) -> None:
        self._bin = unit * 1e-3
        self._counts = array("q", bytes(8 * _BINS))
        self._largest = 0.0

    def add(self, duration: float) -> None:
        """Count one duration [s]; one below zero counts as zero, one that is not finite does not count."""
        if math.isfinite(duration):
            self._counts[int(min(max(duration / self._bin, 0.0), _BINS - 1))] += 1
            self._largest = max(self._largest, duration)

    def percentiles(self, unit: float) -> Percentiles:
        """In multiples of ``unit`` [s]."""
        cumulative = np.cumsum(self._counts)
        if not cumulative[-1]:
            return NOTHING_MEASURED
        bins = (int(np.searchsorted(cumulative, share * cumulative[-1])) for share in (0.5, 0.99))
        values = (math.inf if index == _BINS - 1 else (index + 1) * self._bin for index in bins)
        middle, high = (min(value, self._largest) / unit for value in values)
        return Percentiles(middle, high, self._largest / unit)
