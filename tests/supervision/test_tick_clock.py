"""Ticks that run a little off their time count as even; those that are late count as late."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.supervision.tick_pacer import TickClock

PERIOD = 0.004


def test_a_busy_machines_ticks_are_even_and_on_time() -> None:
    clock, random = TickClock(PERIOD), np.random.default_rng(1)
    ran = PERIOD * np.arange(2000) + random.uniform(0.0, 6e-4, 2000)
    counted = np.array([clock.at(t) for t in ran])
    assert np.abs(counted - ran).max() < 7e-4
    assert np.diff(counted)[200:].std() < 0.05 * np.diff(ran).std()


def ten_ticks() -> TickClock:
    clock = TickClock(PERIOD)
    for k in range(10):
        clock.at(k * PERIOD)
    return clock


@pytest.mark.parametrize("late", [0.4, 1.7, 20.3])
def test_a_late_tick_counts_for_all_that_were_due_and_those_that_hurry_after_it_for_nothing(late: float) -> None:
    clock = ten_ticks()
    due = 10 + round(late)
    assert clock.at((10 + late) * PERIOD) == pytest.approx(due * PERIOD, abs=0.02 * PERIOD)
    last = clock.at((10 + late + 0.05) * PERIOD)
    assert last == clock.at((10 + late) * PERIOD)
    assert clock.at((due + 1) * PERIOD) == pytest.approx((due + 1) * PERIOD, abs=0.03 * PERIOD)


@pytest.mark.parametrize("gap", [0.2, -0.02])
def test_time_begins_anew_after_a_long_gap_and_where_it_was_set_back(gap: float) -> None:
    clock = ten_ticks()
    now = 9 * PERIOD + gap
    assert clock.at(now) == now
    assert clock.at(now + PERIOD) == pytest.approx(now + PERIOD)
