"""Work from hand samples through the whole stack to MuJoCo is as safe and as close as with targets alone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.motion_run import rest_acceleration
from q2r2_control.benchmark.work_motions import ARMS, WORK_MOTIONS, WorkMotion, carry
from q2r2_control.config.cell import Config, load_config
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.verification.contract import Contract
from work_hands import MOVES, WorkHands

pytestmark = pytest.mark.slow

RATE = 500.0  # the lowest one with one substep a tick, since most of a test's time goes by ticks [Hz]
CARRY = replace(carry(0.20, 0.30, shortest=1.0), rest=0.6)
PASS = replace(WORK_MOTIONS["pass"], rest=0.6)
SLIDE = replace(WORK_MOTIONS["slide"], rest=1.5)


@cache
def config() -> Config:
    cell = load_config("config/dual_iiwa7.yaml")
    empty = cell.mujoco.model_copy(update={"objects": {}})
    control = cell.control.model_copy(update={"solve_time_limit": None})
    return cell.model_copy(update={"loop_rate_hz": RATE, "mujoco": empty, "control": control})


@cache
def robot() -> Robot:
    return Robot.from_config(config())


@dataclass
class Work:
    """A motion that was done: ticks from the end of the approach on."""

    motion: WorkMotion
    hands: WorkHands
    delay: float  # of teleoperation [s]
    contract: Contract
    ticks: list[Tick] = field(default_factory=list)

    def error(self, tick: Tick, late: float = 0.0) -> list[float]:
        """Distance [m] of each tool from where its hand asked it to be ``late`` [s] before."""
        asked = self.hands.asked(tick.t - late)
        return [float(np.linalg.norm(tick.tools[arm].translation - asked[arm].translation)) for arm in asked]

    def rms_error(self, late: float) -> float:
        """Of the worse tool, until the hands rest [m]."""
        errors = [self.error(tick, late) for tick in self.ticks if tick.t <= MOVES + self.motion.rests]
        return float(np.sqrt(np.mean(np.square(errors), axis=0)).max())


def work(motion: WorkMotion, mode: str, seed: int | None = 0) -> Work:
    """Do ``motion`` in ``mode``; every promise is checked at every tick."""
    start: dict[str, pin.SE3] = {arm: robot().tool_pose(robot().home, arm) for arm in ARMS}
    hands = WorkHands(motion, start, config().teleop, seed)
    pipeline = Pipeline(config(), robot(), hands, MujocoPlant(robot(), config()), mode)
    done = Work(motion, hands, pipeline.teleop.delay, Contract(pipeline.controller))

    def keep(tick: Tick) -> None:
        done.contract.observe(tick.reference, tick.step)
        if tick.t > MOVES + motion.begins:
            done.ticks.append(tick)

    pipeline.listeners.append(keep)
    summary = pipeline.run(MOVES + motion.ends, realtime=False)
    assert [event.destination for event in summary.events if event.arm == "left"] == ["engaged"]
    assert max(arm.slip_mm_max for arm in summary.arms.values()) == 0.0
    return done


def assert_safe(done: Work) -> None:
    """Every promise at every tick; measured links at their distances, motors within their torques."""
    assert {margin.name: margin.violations for margin in done.contract.margins.values() if margin.violations} == {}
    assert not any(tick.reference.report.fallback for tick in done.ticks)
    kept = kept_distances(robot(), config().control).values
    assert min(float((robot().distance_values(tick.state.q) - kept).min()) for tick in done.ticks[::4]) > 0.0
    assert max(float((np.abs(tick.state.tau) / robot().torque_limit).max()) for tick in done.ticks) < 0.9


@pytest.mark.parametrize("mode", ["position", "torque"])
def test_arms_that_carry_something_follow_the_hands_closely(mode: str) -> None:
    done = work(CARRY, mode)
    assert_safe(done)
    # All but the filter's delay, of which 0.3 m/s makes 13.5 mm.
    assert done.rms_error(late=done.delay) < 7.0e-3
    assert done.rms_error(late=0.0) < 20.0e-3


def test_arms_get_past_each_other_where_the_hands_lead_them() -> None:
    done = work(PASS, "torque")
    assert_safe(done)
    assert max(done.error(done.ticks[-1])) < 3.0e-3


def test_a_hand_that_presses_down_slides_the_tool_over_the_table_and_rests_there() -> None:
    done = work(SLIDE, "torque", seed=None)
    assert_safe(done)
    assert 10.0e-3 < max(done.error(done.ticks[-1])) < 11.0e-3, "10 mm lower than it may"
    assert rest_acceleration(np.array([tick.reference.v for tick in done.ticks]), 1.0 / RATE) < 0.1
