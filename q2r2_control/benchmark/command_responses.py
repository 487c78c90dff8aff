"""Which joint commands answered a step of their target, and how long that took. Knows no ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from q2r2_control.types import Array

# Of the acceleration limit: a step asks for all of it at once, and what the step before left has faded to a tenth.
_ANSWER = 0.4


@dataclass(frozen=True, slots=True)
class Recording:
    """Steps of one way in and the commands meanwhile; times of one clock [s], ascending."""

    steps: Sequence[float]  # when each was published
    sent: Sequence[float]  # when commands were, by the middleware's stamps
    received: Sequence[float]
    v: Array  # (n, nv) of the commands [rad/s]


@dataclass(frozen=True, slots=True)
class LatencyRow:
    """Latencies of one way in, from the step until the command was received."""

    way: str
    steps: int
    missed: int  # not answered before the next step
    p50_ms: float | None  # None without any answer
    p99_ms: float | None
    max_ms: float | None


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """What ``q2r2 bench --ros`` measured."""

    loop_rate_hz: float  # of the controller, asked for
    transport_p50_ms: float  # of a joint command between two processes, contained in all rows
    transport_p99_ms: float
    rows: tuple[LatencyRow, ...]

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def latency_report(rate: float, acceleration_limit: float, ways: Mapping[str, Recording]) -> LatencyReport:
    """Judge what was recorded with the controller at ``rate`` [Hz] and its limit [rad/s^2]."""
    transport = 1e3 * np.concatenate([np.subtract(way.received, way.sent) for way in ways.values()])
    median, tail = np.percentile(transport, [50.0, 99.0]).tolist()
    return LatencyReport(rate, median, tail, tuple(_row(name, way, acceleration_limit) for name, way in ways.items()))


def _row(name: str, way: Recording, acceleration_limit: float) -> LatencyRow:
    """Find the first command after each step whose velocity changes as fast as only a step makes it."""
    times = np.asarray(way.sent)
    # A late tick changes the velocity by more, an early one by less; none is counted as shorter than half the usual.
    dt = np.diff(times)
    acceleration = np.abs(np.diff(way.v, axis=0)).max(axis=1) / np.maximum(dt, 0.5 * np.median(dt))
    answering = np.concatenate([[False], acceleration > _ANSWER * acceleration_limit])
    latencies = []
    # The last one ends the recording, before it could be answered.
    for step, following in zip(way.steps[:-1], way.steps[1:], strict=True):
        first, last = np.searchsorted(times, [step, following])
        if len(found := np.flatnonzero(answering[first:last])):
            latencies.append(1e3 * (way.received[first + found[0]] - step))
    counted = len(way.steps) - 1
    percentiles = np.percentile(latencies, [50.0, 99.0, 100.0]).tolist() if latencies else (None, None, None)
    return LatencyRow(name, counted, counted - len(latencies), *percentiles)
