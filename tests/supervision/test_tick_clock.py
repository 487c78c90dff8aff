"""Ticks that run a little off their time count as even; those that are late count as late."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.supervision.tick_clock import TickClock

PERIOD = 0.004


def test_a_busy_machines_ticks_are_even_and_on_time() -> None:
    clock, random = TickClock(PERIOD), np.random.default_rng(1)
    ran = PERIOD * np.arange(2000) + random.uniform(0.0, 6e-4, 2000)
    counted = np.array([clock.at(t) for t in ran])
    assert np.abs(counted - ran).max() < 7e-4
    assert np.diff(counted)[200:].std() < 0.05 * np.diff(ran).std()


@pytest.mark.parametrize("late", [0.6, 1.5, 20.0, -3.0])
def test_a_tick_that_is_late_by_half_a_period_or_in_the_past_counts_when_it_runs(late: float) -> None:
    clock = TickClock(PERIOD)
    for k in range(10):
        clock.at(k * PERIOD)
    now = (10 + late) * PERIOD
    assert clock.at(now) == now


def test_another_rate_than_the_wanted_one_is_kept_up_with() -> None:
    clock = TickClock(PERIOD)
    for k in range(5000):
        now = k * 1.002 * PERIOD
        assert abs(clock.at(now) - now) <= 0.5 * PERIOD
