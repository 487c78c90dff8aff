"""The loop's clock, with a simulated computer's clock whose sleeps are late by given times."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.pipeline import loop_clock
from q2r2_control.pipeline.loop_clock import LoopClock, PlantClock, WallPace
from q2r2_control.types import RobotState

PERIOD = 0.01


class LateSleeper:
    """A replacement for the module ``time``.

    Each sleep lasts longer than its argument by the next value of ``delays`` [s].
    """

    def __init__(self, delays: list[float]) -> None:
        self._now, self._delays = 100.0, delays

    def monotonic(self) -> float:
        return self._now

    def perf_counter(self) -> float:
        return self._now

    def advance(self, duration: float) -> None:
        self._now += duration

    def sleep(self, duration: float) -> None:
        self._now += duration + (self._delays.pop(0) if self._delays else 0.0)


def _ticks(monkeypatch: pytest.MonkeyPatch, delays: list[float], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the ticks since the start, and the dt of each [s]."""
    monkeypatch.setattr(loop_clock, "time", LateSleeper(delays))
    loop = LoopClock(PERIOD, realtime=True)
    steps, times = np.array([(loop.wait(), loop.now - loop.start) for _ in range(count)]).T
    return times, steps


def test_the_lateness_of_one_tick_does_not_delay_later_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    delays = np.random.default_rng(1).uniform(0.0, 0.8 * PERIOD, 200).tolist()
    lateness = _ticks(monkeypatch, delays, 200)[0] - PERIOD * np.arange(1, 201)
    assert ((lateness >= -1e-9) & (lateness <= 0.8 * PERIOD + 1e-9)).all()


def test_the_dt_of_every_tick_is_the_time_that_really_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    delays = [2.0, *np.random.default_rng(2).uniform(0.0, 3.0 * PERIOD, 99).tolist()]
    times, steps = _ticks(monkeypatch, delays, 100)
    np.testing.assert_allclose(np.diff(times, prepend=0.0), steps, atol=2e-6)
    assert steps[0] == pytest.approx(2.0 + PERIOD)


def test_missed_ticks_are_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    times, steps = _ticks(monkeypatch, [0.0, 0.07, 0.0, 0.0, 0.0], 6)
    assert steps[1] == pytest.approx(0.08)
    assert np.sum(np.diff(times) < 0.5 * PERIOD) <= 1, "one tick follows at once, then the grid goes on"


def test_simulated_time_takes_no_real_time_and_is_never_late() -> None:
    loop = LoopClock(PERIOD, realtime=False)
    assert [loop.wait() for _ in range(3)] == [PERIOD] * 3
    assert loop.now == pytest.approx(3 * PERIOD)
    assert loop.after(3 * PERIOD)
    assert not loop.after(4 * PERIOD)
    assert (loop.overruns, loop.lateness.percentiles(1e-3).max) == (0, None), "it is never late"


def paced_run(monkeypatch: pytest.MonkeyPatch, ticks: int, busy_s: float) -> tuple[LoopClock, float]:
    """Run a loop for ``ticks`` ticks with a paced clock. Each tick keeps the computer busy for ``busy_s``.

    Return the clock, and the real time that the ticks took [s].
    """
    computer = LateSleeper([])
    monkeypatch.setattr(loop_clock, "time", computer)
    loop, began = LoopClock(PERIOD, realtime=False, pace=WallPace()), computer.monotonic()
    for tick in range(1, ticks + 1):
        assert loop.wait() == PERIOD
        assert loop.now == tick * PERIOD
        computer.advance(busy_s)
    return loop, computer.monotonic() - began


def test_paced_time_passes_as_fast_as_real_time_on_a_fast_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, took = paced_run(monkeypatch, 1000, busy_s=0.3 * PERIOD)
    assert took == pytest.approx(1000 * PERIOD, abs=2 * PERIOD)
    assert loop.real_time_factor() == pytest.approx(1.0, rel=0.01)
    assert (loop.overruns, loop.falls_behind()) == (0, False)


def test_paced_time_passes_more_slowly_than_real_time_on_a_slow_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, took = paced_run(monkeypatch, 1000, busy_s=2.5 * PERIOD)
    assert took == pytest.approx(2500 * PERIOD)
    assert loop.real_time_factor() == pytest.approx(0.4, rel=0.01)
    assert (loop.overruns, loop.falls_behind()) == (0, False)


def test_paced_time_does_not_catch_up_after_a_long_stall_of_the_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    computer = LateSleeper([])
    monkeypatch.setattr(loop_clock, "time", computer)
    loop = LoopClock(PERIOD, realtime=False, pace=WallPace())
    loop.wait()
    computer.advance(10.0)
    began = computer.monotonic()
    for _ in range(100):
        loop.wait()
    assert computer.monotonic() - began >= 100 * PERIOD - 0.1 - 2 * PERIOD


def test_a_loop_falls_behind_if_it_is_late_in_more_than_a_tenth_of_the_ticks_of_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    often, seldom = ([2.5 * PERIOD if tick % every == 0 else 0.0 for tick in range(400)] for every in (5, 40))
    for delays, falls_behind in ((often, True), (seldom, False)):
        monkeypatch.setattr(loop_clock, "time", LateSleeper(delays))
        loop, found = LoopClock(PERIOD, realtime=True), []
        for _ in range(300):
            loop.wait()
            found.append(loop.falls_behind())
        assert any(found) == falls_behind
        assert sum(found) <= 4, "it is asked about once a second"


def test_lateness_and_overruns_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop_clock, "time", LateSleeper([0.001, 0.0, 0.025, 0.0, 0.002, 0.0]))
    loop = LoopClock(PERIOD, realtime=True)
    for _ in range(6):
        loop.wait()
    late = loop.lateness.percentiles(1e-3)
    # The third tick is 25 ms late. The later due times are counted from this tick, so the fourth tick is not late.
    assert loop.overruns == 1
    assert (late.p50, late.max) == (pytest.approx(0.0, abs=2e-3), pytest.approx(25.0))
    assert late.p99 == pytest.approx(25.0)


def state(stamp: float) -> RobotState:
    return RobotState(np.zeros(2), np.zeros(2), np.zeros(2), None, stamp)


def test_a_state_counts_as_new_even_if_the_plants_own_clock_has_jumped_back() -> None:
    clock = PlantClock(state(1000.0))
    for stamp, now, expected in ((1000.25, 5.25, 0.25), (1000.5, 5.5, 0.25), (1000.0, 5.75, -0.5)):
        clock.give(0.25)
        seen, passed = clock.stamped(state(stamp), now)
        assert (seen.stamp, passed) == (now, expected)


def test_a_repeated_state_ages_by_the_time_for_which_the_plant_was_advanced() -> None:
    clock, stopped = PlantClock(state(0.0)), state(0.0)
    for tick in range(1, 4):
        clock.give(0.25)
        seen, passed = clock.stamped(stopped, 5.0 + 0.25 * tick)
        assert (seen.stamp, passed) == (5.0, 0.0)
    seen, passed = clock.stamped(state(0.75), 6.0)
    assert (seen.stamp, passed) == (6.0, 0.75)
