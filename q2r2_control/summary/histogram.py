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


# Values wait for as many, since adding one to the counts takes ten times as long as keeping it.
_BATCH = 256


class Histogram:
    """Counts of durations in thousandths of ``unit`` [s], up to 100 units: percentiles of any number of values."""

    def __init__(self, unit: float) -> None:
        self._bin = unit * 1e-3
        self._unit = unit
        self._counts = np.zeros(100_000, dtype=np.int64)
        self._largest = 0.0
        self._batch: list[float] = []  # not in the counts yet

    def add(self, duration: float) -> None:
        """Count one duration [s]; one below zero counts as zero, one that is not finite does not count."""
        if math.isfinite(duration):
            self._batch.append(duration)
            if len(self._batch) == _BATCH:
                self._sort_in()

    def _sort_in(self) -> None:
        durations = np.array(self._batch)
        self._batch.clear()
        # A value is cut off before it is divided, since a huge one would be infinite.
        bins = (np.minimum(np.maximum(durations, 0.0), self._bin * len(self._counts)) / self._bin).astype(np.int64)
        np.add.at(self._counts, np.minimum(bins, len(self._counts) - 1), 1)
        self._largest = max(self._largest, float(durations.max(initial=0.0)))

    def percentiles(self) -> Percentiles:
        """In multiples of the unit."""
        self._sort_in()
        total = int(self._counts.sum())
        if total == 0:
            return NOTHING_MEASURED
        cumulative = np.cumsum(self._counts)
        largest = self._largest / self._unit
        bins = (int(np.searchsorted(cumulative, share * total)) for share in (0.5, 0.99))
        middle, high = (largest if i == len(cumulative) - 1 else min((i + 1) * 1e-3, largest) for i in bins)
        return Percentiles(middle, high, largest)
