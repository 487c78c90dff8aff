"""Finding the command that answers a step, in commands that are made up and so have known latencies."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.benchmark.command_responses import CommandRecording, latency_report

PERIOD = 0.004  # [s]
LIMIT = np.array([20.0, 20.0, 20.0, 10.0, 20.0, 20.0, 20.0])  # [rad/s^2]


def recording(steps: list[float], delays: list[float | None], noise: float = 0.0) -> CommandRecording:
    """Commands every 4 ms for a second; each step makes a joint fast, then slower and slower, after its delay."""
    times = np.arange(0.0, 1.0, PERIOD)
    v = np.zeros((len(times), 7))
    for step, delay in zip(steps, delays, strict=True):
        if delay is not None:
            since = times - step - delay
            v[:, 3] += np.where(since >= -1e-9, LIMIT[3] * PERIOD * np.exp(-np.maximum(since, 0.0) / 0.1), 0.0)
    v += noise * np.random.default_rng(1).normal(size=v.shape)
    return CommandRecording(steps, times.tolist(), (times + 0.001).tolist(), v)


def test_a_latency_is_from_the_step_to_the_receipt_of_its_answer() -> None:
    (row,) = latency_report(250.0, LIMIT, {"way": recording([0.1, 0.2, 0.3, 0.9], [0.004, 0.004, 0.02, None])}).rows
    assert (row.path, row.steps, row.missed) == ("way", 3, 0)
    assert row.p50_ms == pytest.approx(5.0)
    assert row.max_ms == pytest.approx(21.0)


def test_what_was_not_answered_before_the_next_step_is_missed_and_not_a_latency() -> None:
    (row,) = latency_report(250.0, LIMIT, {"way": recording([0.1, 0.2, 0.3], [None, 0.004, None])}).rows
    assert (row.steps, row.missed) == (2, 1)
    assert row.max_ms == pytest.approx(5.0)


def test_without_any_answer_there_are_no_latencies() -> None:
    (row,) = latency_report(250.0, LIMIT, {"way": recording([0.1, 0.2], [None, None], noise=1e-3)}).rows
    assert (row.missed, row.p50_ms, row.p99_ms, row.max_ms) == (1, None, None, None)


def test_the_transport_is_from_the_middlewares_stamp_of_sending_to_that_of_receipt() -> None:
    report = latency_report(250.0, LIMIT, {"way": recording([0.1, 0.2], [0.0, None])})
    assert report.transport_p50_ms == pytest.approx(1.0)
    assert report.as_json()["rows"][0]["steps"] == 1
