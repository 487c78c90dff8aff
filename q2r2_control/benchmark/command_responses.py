"""Finds the joint command that answers a step of a target, and its latency. Imports no ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from q2r2_control.types import Array

# Share of the acceleration limit that marks an answer: a step asks for all of it, the one before for a tenth by then.
_ANSWER_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class CommandRecording:
    """Steps of one input and the joint commands meanwhile; times of one clock [s], ascending."""

    steps: Sequence[float]  # when each step was published
    sent: Sequence[float]  # when each command was published, by the middleware's stamps
    received: Sequence[float]  # and received
    v: Array  # (n, nv) of the commands [rad/s]


@dataclass(frozen=True, slots=True)
class LatencyRow:
    """Latencies of one input, from the step until the command was received."""

    path: str  # from which topic to which
    steps: int
    missed: int  # not answered before the next step
    p50_ms: float | None  # None without any answer
    p99_ms: float | None
    max_ms: float | None


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """What ``q2r2 bench --ros`` measured."""

    loop_rate_hz: float  # of the controller, as configured
    transport_p50_ms: float  # of a joint command between two processes, contained in all rows
    transport_p99_ms: float
    rows: tuple[LatencyRow, ...]

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def latency_report(rate: float, acceleration_limit: Array, recordings: Mapping[str, CommandRecording]) -> LatencyReport:
    """Latencies by path, of a controller at ``rate`` [Hz] with ``acceleration_limit`` (nv,) [rad/s^2]."""
    transport = 1e3 * np.concatenate(
        [np.subtract(recording.received, recording.sent) for recording in recordings.values()]
    )
    median, tail = np.percentile(transport, [50.0, 99.0]).tolist()
    return LatencyReport(
        rate, median, tail, tuple(_row(path, recording, acceleration_limit) for path, recording in recordings.items())
    )


def _row(path: str, recording: CommandRecording, acceleration_limit: Array) -> LatencyRow:
    """Find the first command after each step with an acceleration that only a step causes."""
    times = np.asarray(recording.sent)
    # Ticks may be early or late, so changes of velocity are divided by dt; half the usual dt is the least that counts.
    dt = np.diff(times)
    change = np.abs(np.diff(recording.v, axis=0) / acceleration_limit).max(axis=1)
    answering = np.concatenate([[False], change > _ANSWER_SHARE * np.maximum(dt, 0.5 * np.median(dt))])
    latencies = []
    # The last step is left out: the recording ends before its answer.
    for step, following in zip(recording.steps[:-1], recording.steps[1:], strict=True):
        first, last = np.searchsorted(times, [step, following])
        if len(found := np.flatnonzero(answering[first:last])):
            latencies.append(1e3 * (recording.received[first + found[0]] - step))
    counted = len(recording.steps) - 1
    percentiles = np.percentile(latencies, [50.0, 99.0, 100.0]).tolist() if latencies else (None, None, None)
    return LatencyRow(path, counted, counted - len(latencies), *percentiles)
