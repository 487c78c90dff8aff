"""Runs in which the arms move slowly: how fast they are, how they come to rest, and what ends a motion early."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import PlantError
from q2r2_control.pipeline.slow_run import SPEED
from tests.pipeline.slow_cell import PendantCabinets, StuckArm, slow_run


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("config/dual_iiwa7_fri.yaml")


@pytest.mark.slow
def test_no_joint_is_faster_than_a_twentieth_of_its_limit_and_all_joints_rest_at_the_end(config: Config) -> None:
    cabinets: list[PendantCabinets] = []
    with slow_run(config, prepare=cabinets.append) as run:
        goal = run.reference + 0.2 * np.tile([0, 0, 0, 1, 1, 1, -1], 2)
        there = run.lead_to(goal)
        assert there is not None
        led = run.let_go(["right"], 1.0)
    speeds = np.abs([moment.v for moment in there + led]) / run.robot.velocity_limit
    assert 0.8 * SPEED < speeds.max() <= SPEED * (1.0 + 1e-9)
    assert np.abs(there[-1].reference - goal).max() < 0.004
    for moments in (there, led):
        assert np.abs(moments[-1].q - moments[-1].reference).max() < 1e-3
    assert any(moment.engaged["right"] for moment in led)
    assert not any(moment.engaged["left"] for moment in led)
    assert [cabinet.trips for cabinet in cabinets[0].cabinets.values()] == [[], []]
    assert run.is_over


def test_the_arms_do_not_move_if_the_straight_path_to_the_goal_is_not_free(config: Config) -> None:
    with slow_run(config) as run:
        start = run.reference
        into_the_table = start.copy()
        into_the_table[run.robot.arms["left"].joints[1]] += 0.6
        assert run.lead_to(into_the_table) is None
        assert np.abs(run.reference - start).max() < 1e-9


@pytest.mark.slow
def test_the_end_of_a_session_is_reported_and_the_motion_may_be_repeated(config: Config) -> None:
    cabinets: list[PendantCabinets] = []
    with slow_run(config, prepare=cabinets.append) as run:
        goal = run.reference.copy()
        goal[0] += 0.3

        def end_once(arm: str, now: float) -> None:
            its = cabinets[0].cabinets["left"]
            if abs(its.arm.q[0] - goal[0]) < 0.2:
                its.stop()
                cabinets[0].on_message = lambda arm, now: None

        cabinets[0].on_message = end_once
        with pytest.raises(PlantError, match="left: the cabinet "):
            run.lead_to(goal)
        assert run.lead_to(goal) is not None


@pytest.mark.slow
def test_cabinets_that_do_not_allow_commands_are_named(config: Config) -> None:
    def lock(cabinets: PendantCabinets) -> None:
        cabinets.locked = True

    with pytest.raises(PlantError, match="left: the cabinet is in monitoring ready"), slow_run(config, prepare=lock):
        pytest.fail("nothing may be led")


@pytest.mark.slow
def test_arms_that_do_not_follow_at_all_end_the_run_with_a_reason(config: Config) -> None:
    with slow_run(config, StuckArm) as run:
        with pytest.raises(PlantError, match=r"left_A7"):
            run.lead_to(run.reference + 0.4 * (np.arange(len(run.reference)) == 6))
        assert run.is_over
