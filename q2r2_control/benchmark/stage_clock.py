"""Clocks in a loop: to which of its stages each moment of a tick belongs."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from q2r2_control.types import Array

PHYSICS, REST = "physics", "rest of the loop"
STAGES = ("inputs", "measured state", "teleop", "supervision", "control", "drive", "apply", "recording", REST, PHYSICS)


class StageClock:
    """Charges every moment of a run to the innermost watched function that runs, or to :data:`REST`."""

    def __init__(self, period: float = 0.0) -> None:
        """``period`` [s]: ticks are held back until one is over since the last."""
        self._period = period
        self._due = self._last = time.perf_counter()
        self._stage = STAGES.index(REST)
        self._row = [0.0] * len(STAGES)
        self._rows: list[list[float]] = []
        self._watched: list[tuple[object, str]] = []

    @property
    def times(self) -> Array:
        """(ticks, stages) [s]; what came before the first tick is left out."""
        return np.array(self._rows[1:])

    def watch(self, owner: object, name: str, stage: str) -> None:
        """Charge calls of a method of ``owner`` to ``stage``, until :meth:`release`."""
        method, index = getattr(owner, name), STAGES.index(stage)

        def timed(*arguments: Any, **options: Any) -> Any:
            before = self._turn_to(index)
            try:
                return method(*arguments, **options)
            finally:
                self._turn_to(before)

        setattr(owner, name, timed)
        self._watched.append((owner, name))

    def watch_ticks(self, owner: object, name: str) -> None:
        """Begin a row at every call of a method of ``owner``."""
        method = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            self._begin_row()
            return method(*arguments, **options)

        setattr(owner, name, timed)
        self._watched.append((owner, name))

    def release(self) -> None:
        """Leave all owners as they were."""
        for owner, name in self._watched:
            delattr(owner, name)
        self._watched.clear()

    def _turn_to(self, stage: int) -> int:
        now = time.perf_counter()
        before, self._stage = self._stage, stage
        self._row[before] += now - self._last
        self._last = now
        return before

    def _begin_row(self) -> None:
        self._turn_to(self._stage)
        self._rows.append(self._row)
        self._row = [0.0] * len(STAGES)
        self._due = max(self._due + self._period, self._last - self._period)
        if (rest := self._due - time.perf_counter()) > 0.0:
            time.sleep(rest)
        self._last = time.perf_counter()
