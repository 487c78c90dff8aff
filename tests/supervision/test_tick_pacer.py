"""A late tick moves no joint farther than its velocity limit allows in one period."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from q2r2_control.supervision.tick_pacer import TickPacer

PERIOD, ACCELERATION = 0.004, np.array([10.0, 4.0])
LIMIT = np.array([1.7, 3.1])


@given(gap=st.floats(1e-6, 10.0), shares=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)))
def test_no_joint_can_go_farther_than_in_one_period_at_its_limit(gap: float, shares: tuple[float, float]) -> None:
    v = LIMIT * np.array(shares)
    step = TickPacer(PERIOD, LIMIT, ACCELERATION).step(gap, v)
    assert min(gap, PERIOD) <= step * (1.0 + 1e-9)
    assert step <= gap
    if step > PERIOD * (1.0 + 1e-6):
        farthest = np.abs(v) * step + 0.5 * ACCELERATION * step * step
        assert (farthest <= LIMIT * PERIOD * (1.0 + 1e-9)).all()


def test_a_tick_in_time_passes_to_the_bit_and_a_clock_that_stands_or_goes_back_moves_nothing() -> None:
    pacer = TickPacer(PERIOD, LIMIT, ACCELERATION)
    assert [pacer.step(gap, LIMIT) for gap in (PERIOD, 0.3 * PERIOD, 0.0, -1.0)] == [PERIOD, 0.3 * PERIOD, 0.0, 0.0]
    assert pacer.missed_ticks == 0
    assert pacer.stretched == 0.0


def test_slow_motion_catches_up_and_fast_motion_is_stretched_and_counted() -> None:
    slow, fast = (TickPacer(PERIOD, LIMIT, ACCELERATION) for _ in range(2))
    assert slow.step(3.0 * PERIOD, 0.1 * LIMIT) == 3.0 * PERIOD
    assert slow.stretched == 0.0
    assert fast.step(25.0 * PERIOD, LIMIT) == PERIOD
    assert fast.stretched == pytest.approx(24.0 * PERIOD)
    assert slow.missed_ticks == 2
    assert fast.missed_ticks == 24
