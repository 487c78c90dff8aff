"""Commissioning moves arms slowly, measures the motion, and compares the results with bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import PlantError
from q2r2_control.pipeline.commissioning import JointMotion, let_go_report, measure_joint, measure_stop
from q2r2_control.pipeline.slow_run import Moment
from q2r2_control.robot.robot import Robot
from tests.pipeline.slow_cell import StuckArm, slow_run


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("config/dual_iiwa7_fri.yaml")


@pytest.fixture(scope="module")
def robot(config: Config) -> Robot:
    return Robot.from_config(config)


@pytest.mark.slow
def test_one_joint_moves_by_a_degree_and_back_while_all_other_joints_rest(config: Config) -> None:
    with slow_run(config) as run:
        start = run.reference
        motion = measure_joint(run, 8)
        assert np.abs(run.reference - start).max() < 0.004
    assert motion.joint == "right_A2"
    assert abs(motion.commanded_deg) == pytest.approx(1.0, abs=0.02)
    assert motion.measured_deg == pytest.approx(motion.commanded_deg, abs=0.01)
    assert motion.others_deg < 0.01


@pytest.mark.slow
def test_the_error_about_a_joint_that_does_not_move_names_the_joint(config: Config) -> None:
    with slow_run(config, StuckArm) as run, pytest.raises(PlantError, match=r"left_A1: commanded .* measured 0\.00"):
        measure_joint(run, 0)


@pytest.mark.parametrize(
    "motion",
    [
        JointMotion("A1", 1.0, 0.7, 0.1, 0.0),
        JointMotion("A1", 1.0, 1.0, 0.9, 0.0),
        JointMotion("A1", 1.0, 1.0, 0.1, 0.3),
        JointMotion("A1", 1.0, -1.0, 0.1, 0.0),
    ],
    ids=["too short", "far behind", "not alone", "the other way"],
)
def test_it_is_an_error_if_a_joint_does_not_follow_or_if_other_joints_move_with_it(motion: JointMotion) -> None:
    JointMotion("A1", 1.0, 0.9, 0.5, 0.1).check()
    with pytest.raises(PlantError, match="A1: commanded 1"):
        motion.check()


@pytest.mark.slow
def test_if_a_hand_releases_its_arm_the_arm_stops_within_the_certified_stop_plus_the_latency(config: Config) -> None:
    with slow_run(config) as run:
        report = measure_stop(run, "left")
    assert report.tool_speed_mm_s == pytest.approx(30.0, abs=1.0)
    assert 0.0 < report.stopped_mm < report.allowed_mm
    assert report.stopped_s < report.allowed_s


def moments(robot: Robot, on: float, engaged: bool = True) -> list[Moment]:
    """Return a :class:`Moment` for each tick of a motion of the left arm's joint A2 at 0.1 rad/s.

    The arm follows its hand for one second. After its release, the arm moves on for ``on`` [s].
    """
    v = np.zeros(robot.model.nv)
    v[1] = 0.1
    none, slow = np.zeros_like(v), np.full_like(v, 5.0)
    times = np.arange(0.0, 3.0, 0.01)
    return [
        Moment(
            t,
            robot.home - v * min(t, 1.0 + on),
            none,
            none,
            robot.home - v * t,
            -v,
            slow,
            {"left": bool(engaged and t < 1.0)},
        )
        for t in times
    ]


def test_a_stop_that_is_too_late_or_too_long_is_reported(robot: Robot) -> None:
    let_go_report(robot, "left", moments(robot, 0.1)).check()
    with pytest.raises(PlantError, match=r"the left arm, let go, stopped after .* mm and 0\.2. s; allowed"):
        let_go_report(robot, "left", moments(robot, 0.3)).check()
    late = replace(let_go_report(robot, "left", moments(robot, 0.1)), stopped_s=0.3)
    with pytest.raises(PlantError, match="stopped after"):
        late.check()


def test_an_arm_that_did_not_follow_the_hand_causes_an_error_instead_of_a_measurement(robot: Robot) -> None:
    with pytest.raises(PlantError, match="the left arm did not follow the hand"):
        let_go_report(robot, "left", moments(robot, 0.0, engaged=False))
    still = replace(let_go_report(robot, "left", moments(robot, 0.1)), tool_speed_mm_s=1.0)
    with pytest.raises(PlantError, match="did not go up"):
        still.check()
