"""Two arms work close together, and keep the contract. A motion in which no pair comes too close is not slowed."""

from __future__ import annotations

from functools import cache

import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.benchmark.motion_run import MotionFigures, OwnController, run_motion, without_pairs
from q2r2_control.benchmark.work_motions import WORK_MOTIONS, WorkMotion
from tests.support.driven import Driven

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")
# The solver has no time limit, so that no result depends on the speed of the computer.
SETTINGS = CONFIG.control.model_copy(update={"solve_time_limit": None})
# Time after the motion in which the arms come to rest [s]. Arms that block each other first slide along each other.
STILL = 3.0


@cache
def robot_of(free: bool) -> Robot:
    return without_pairs(CONFIG) if free else Robot.from_config(CONFIG)


@cache
def figures_of(name: str, free: bool = False) -> MotionFigures:
    """Run a work motion with our controller, and return the measured figures. If ``free``, no pair is monitored."""
    robot = robot_of(free)
    return run_motion(OwnController(robot, CONFIG), robot, WORK_MOTIONS[name])


def rms(name: str, free: bool = False) -> float:
    """Return the RMS position error of the worse tool [mm]."""
    error = figures_of(name, free).rms_error_mm
    assert error is not None
    return error


# Of the motions that carry something, only the one with the nearest arms and the highest speed is checked.
CHECKED = [name for name in WORK_MOTIONS if not name.startswith("carry")] + ["carry-0.16-0.50"]


@pytest.mark.parametrize("motion", [WORK_MOTIONS[name] for name in CHECKED], ids=CHECKED)
def test_work_motions_keep_the_contract_at_every_tick_with_hardly_any_fallback_and_end_at_rest(
    motion: WorkMotion,
) -> None:
    run = Driven(CartesianController(robot_of(free=False), SETTINGS))
    run.drive(motion.ends + STILL, lambda t, start: motion.targets(min(t, motion.ends), start))
    contract = run.contract
    assert contract.uncertified == 0
    assert contract.fallback_share < 0.01
    assert contract.tail_acceleration() < 0.1


def test_arms_that_carry_something_close_together_follow_nearly_as_accurately_as_in_free_air() -> None:
    name = "carry-0.20-0.50"
    assert rms(name) <= 1.5 * rms(name, free=True)
    assert figures_of(name).fallback_percent == 0.0


@pytest.mark.parametrize(("name", "time"), [("pass", 2.0), ("pass-back", 2.0), ("cross", 4.5), ("reach-under", 2.0)])
def test_arms_get_past_each_other_if_there_is_a_path(name: str, time: float) -> None:
    arrival = figures_of(name).arrival_s
    assert arrival is not None
    assert arrival < time
