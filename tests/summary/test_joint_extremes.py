"""Extremes of a run are those of all its ticks, whichever batch a tick falls into."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.robot.robot import Robot
from q2r2_control.summary.joint_extremes import JointExtremes
from q2r2_control.types import Reference, StepReport, StepStatus
from tests.support.watch import cell

REPORT = StepReport(StepStatus.OK, (), (), ("left_a", "right_b"), 0.2, True, False, 0.0, 1e-5)
ROBOT = Robot.from_config(cell())


@pytest.mark.parametrize("ticks", [1, 255, 256, 257, 1000])
def test_they_are_those_of_every_tick_in_any_batch(ticks: int) -> None:
    random = np.random.default_rng(ticks)
    control = cell().control.model_copy(update={"velocity_scale": 0.5, "acceleration_limit": 4.0})
    q = random.uniform(ROBOT.position_lower, ROBOT.position_upper, (ticks, 14))
    v, a = random.normal(size=(2, ticks, 14))
    extremes = JointExtremes(ROBOT, control)
    for row in range(ticks):
        extremes.add(Reference(q[row], v[row], a[row], REPORT))
    room = np.minimum(q - ROBOT.position_lower, ROBOT.position_upper - q)
    # To the bit: a batch changes the order of comparisons only.
    assert extremes.velocity_ratio == (np.abs(v) / (0.5 * ROBOT.velocity_limit)).max()
    assert extremes.acceleration_ratio == np.abs(a).max() / 4.0
    assert extremes.position_margin == room.min() - control.position_margin
    extremes.add(Reference(q[0], 2.0 * v.max() * np.ones(14), a[0], REPORT))
    assert extremes.velocity_ratio == (2.0 * v.max() / (0.5 * ROBOT.velocity_limit)).max(), "asked in mid-run"


def test_a_number_that_is_not_finite_hides_no_other_tick() -> None:
    extremes = JointExtremes(ROBOT, cell().control)
    for speed in (0.25, float("nan")):
        extremes.add(Reference(ROBOT.home, speed * ROBOT.velocity_limit, np.zeros(14), REPORT))
    assert extremes.velocity_ratio == pytest.approx(0.25 / cell().control.velocity_scale)
