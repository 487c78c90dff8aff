"""What follows a press, from times that are known."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.benchmark.press_times import WATCHED, PressRecording, press_report

TICK = 0.005  # [s]


def recording(stall: float = 0.0, target: float = 0.09, motion: float = 0.11, press: float = 1.0) -> PressRecording:
    """A press, and a node whose next tick but one takes longer by ``stall`` [s]; targets and motion begin as said."""
    ticks = press - 0.102 + TICK * np.arange(250)
    ticks[ticks > press + TICK] += stall
    commands = press + 0.004 * np.arange(-20, 300)
    speeds = np.where(commands >= press + motion - 1e-9, 0.1, 1e-4)
    targets = press + target + TICK * np.arange(80)
    return PressRecording(press, ticks.tolist(), targets.tolist(), commands.tolist(), speeds.tolist())


def test_the_first_press_of_each_start_stands_beside_all_later_ones() -> None:
    runs = [[recording(0.07), recording(0.001), recording(0.0)], [recording(0.03), recording(0.0), recording(0.002)]]
    report = press_report(runs)
    first, later = report.rows
    assert (report.starts, first.press, first.count, later.press, later.count) == (2, "first", 2, "later", 4)
    assert (first.tick_p50_ms, first.tick_max_ms) == pytest.approx((55.0, 75.0))
    assert later.tick_max_ms == pytest.approx(7.0)
    assert report.period_ms == pytest.approx(5.0)
    assert report.as_json()["rows"][0]["tick_max_ms"] == pytest.approx(75.0)


def test_target_and_motion_count_from_the_press_and_what_was_there_before_it_does_not() -> None:
    one = recording(target=0.09, motion=0.12)
    moved_before = [*one.speeds[:3], 0.5, *one.speeds[4:]]
    before = PressRecording(one.press, one.ticks, [0.5, *one.targets], one.commands, moved_before)
    row, _ = press_report([[before, before]]).rows
    assert (row.target_p50_ms, row.motion_p50_ms) == pytest.approx((90.0, 120.0))


def test_a_long_tick_before_the_press_or_long_after_it_does_not_count() -> None:
    one = recording()
    ticks = np.array(one.ticks)
    ticks[ticks < one.press - 0.05] -= 0.1
    ticks[ticks > one.press + WATCHED + 2.0 * TICK] += 0.2
    row, _ = press_report([[PressRecording(one.press, ticks.tolist(), *_rest_of(one))] * 2]).rows
    assert row.tick_max_ms == pytest.approx(5.0)


def test_a_press_that_is_held_up_from_the_tick_before_it_has_all_of_that_tick() -> None:
    one = recording()
    ticks = np.array(one.ticks)
    ticks[ticks > one.press] += 0.04
    row, _ = press_report([[PressRecording(one.press, ticks.tolist(), *_rest_of(one))] * 2]).rows
    assert row.tick_max_ms == pytest.approx(45.0)


def test_a_press_that_moved_nothing_is_unanswered_and_changes_no_figure() -> None:
    silent = recording(motion=0.9)
    row, later = press_report([[silent, silent, recording()]]).rows
    assert (row.count, row.unanswered, row.tick_p50_ms, row.motion_max_ms) == (1, 1, None, None)
    assert (later.count, later.unanswered) == (2, 1)
    assert later.motion_max_ms == pytest.approx(112.0)


def _rest_of(one: PressRecording) -> tuple[list[float], list[float], list[float]]:
    return list(one.targets), list(one.commands), list(one.speeds)
