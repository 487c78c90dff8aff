"""Percentiles of durations, of any number of them in constant memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Of a duration; p50 and p99 to one part in a thousand of the unit, None where nothing was measured."""

    p50: float | None
    p99: float | None
    max: float | None

    def scaled(self, factor: float) -> Percentiles:
        """In units that are smaller by ``factor``."""
        return Percentiles(*(None if value is None else factor * value for value in (self.p50, self.p99, self.max)))


NOTHING_MEASURED = Percentiles(None, None, None)


class Histogram:
    """Counts of durations in thousandths of ``unit`` [s], up to 100 units: percentiles of any number of values."""

    def __init__(self, unit: float) -> None:
        self._bin = unit * 1e-3
        self._unit = unit
        self._counts = np.zeros(100_000, dtype=np.int64)
        self._largest = 0.0

    def add(self, duration: float) -> None:
        """Count one duration [s]; one below zero counts as zero, one that is not finite does not count."""
        if not math.isfinite(duration):
            return
        self._counts[min(max(int(duration / self._bin), 0), len(self._counts) - 1)] += 1
        self._largest = max(self._largest, duration)

    def percentiles(self) -> Percentiles:
        """In multiples of the unit."""
        total = int(self._counts.sum())
        if total == 0:
            return NOTHING_MEASURED
        cumulative = np.cumsum(self._counts)
        largest = self._largest / self._unit
        bins = (int(np.searchsorted(cumulative, share * total)) for share in (0.5, 0.99))
        middle, high = (largest if i == len(cumulative) - 1 else min((i + 1) * 1e-3, largest) for i in bins)
        return Percentiles(middle, high, largest)
