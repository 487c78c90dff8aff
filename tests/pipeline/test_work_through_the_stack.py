"""Work with hand samples through the whole stack in MuJoCo is as safe and as exact as work with targets alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from q2r2_control.benchmark.work_motions import WORK_MOTIONS, WorkMotion, carry
from q2r2_control.config.cell_file import load_config
from work_through_stack import Stack

pytestmark = pytest.mark.slow

RATE = 500.0  # The lowest rate with one substep per tick [Hz]. Fewer ticks make the tests faster.
CARRY = replace(carry(0.20, 0.30, shortest=1.0), rest=0.6)
PASS = replace(WORK_MOTIONS["pass"], rest=0.6)
SLIDE = replace(WORK_MOTIONS["slide"], rest=1.5)


def work(motion: WorkMotion, mode: str, seed: int | None = 0) -> Any:
    """Run ``motion`` in ``mode``, and check every promise at every tick. Return the :class:`StackFigures`."""
    config = load_config("config/dual_iiwa7.yaml").model_copy(update={"loop_rate_hz": RATE})
    return Stack(config, mode).run(motion, seed)


def assert_safe(done: Any) -> None:
    """Assert that promises, distances and torque limits are kept, no arm pauses, and no target slips."""
    assert (done.broken, done.pauses, done.stopped, done.slip_mm) == ({}, [], None, 0.0)
    assert done.fallback_percent == 0.0
    assert done.measured_margin_mm > 0.0
    assert done.max_torque_ratio < 0.9


@pytest.mark.parametrize("mode", ["position", "torque"])
def test_arms_that_carry_something_follow_the_hands_closely(mode: str) -> None:
    done = work(CARRY, mode)
    assert_safe(done)
    # Only the error from the filter's delay remains: 13.5 mm at 0.3 m/s.
    assert done.path_error_mm < 7.0
    assert done.rms_error_mm < 20.0


def test_arms_pass_each_other_if_the_hands_show_them_a_path() -> None:
    done = work(PASS, "torque")
    assert_safe(done)
    assert done.end_error_mm < 3.0


def test_a_hand_that_presses_down_slides_the_tool_along_the_table_until_the_tool_rests() -> None:
    done = work(SLIDE, "torque", seed=None)
    assert_safe(done)
    assert 10.0 < done.end_error_mm < 11.0, "10 mm lower than it may"
    assert done.rest_acceleration < 0.1
