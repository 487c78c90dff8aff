"""Times of the computer's clock become times of the loop's clock, in real time and in slow motion."""

from __future__ import annotations

import pytest

from q2r2_control.cameras.loop_times import LoopTimes, TickTime

# The time of each tick by the computer's clock, and by the loop's clock [s].
TICKS = ((10.0, 10.0), (10.01, 10.01), (10.05, 10.05))


def times_of(ticks: tuple[tuple[float, float], ...] = TICKS) -> LoopTimes:
    found = LoopTimes()
    for number, (computer, loop) in enumerate(ticks):
        found.add(TickTime(computer, loop, number))
    return found


@pytest.mark.parametrize(("at", "number"), [(10.0, 0), (10.004, 0), (10.03, 1), (10.05, 2), (10.2, 2)])
def test_in_real_time_the_times_of_the_loop_equal_the_times_of_the_computer(at: float, number: int) -> None:
    assert times_of().at(at) == pytest.approx((at, at, number))


def test_before_the_first_tick_the_time_of_the_loop_passes_as_fast_as_the_time_of_the_computer() -> None:
    assert times_of(((10.0, 0.5), (10.1, 0.6))).at(9.99) == pytest.approx((9.99, 0.49, 0))


def test_in_slow_motion_the_time_of_the_loop_passes_as_slowly_as_its_ticks() -> None:
    slow = times_of(((10.0, 0.0), (10.1, 0.001), (10.2, 0.002)))
    assert [slow.at(time) for time in (10.0005, 10.05, 10.1004)] == [
        pytest.approx((10.0005, 0.0005, 0)),
        pytest.approx((10.05, 0.001, 0)),
        pytest.approx((10.1004, 0.0014, 1)),
    ]
