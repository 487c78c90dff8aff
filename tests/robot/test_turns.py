"""If the angle of a continuous joint is reported within one turn, turns are counted. Other reports do not change."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turns import TurnCounter
from q2r2_control.types import Array, RobotState

PERIOD = 0.01  # [s]


@pytest.fixture
def robot() -> Any:
    """Return a robot of three joints. The middle joint has limits, and the other joints are continuous."""
    return SimpleNamespace(endless=np.array([True, False, True]), velocity_limit=np.array([2.0, 2.0, 4.0]))


def wrapped(angle: Array) -> Array:
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi


def test_counted_positions_continue_when_reported_angles_wrap_around_at_half_a_turn(robot: Any) -> None:
    counter, t = TurnCounter(robot), np.arange(0.0, 12.0, PERIOD)
    real = np.stack([1.9 * t - 1.0, np.sin(t), -1.7 * t], axis=1)
    reported = real.copy()
    reported[:, [0, 2]] = wrapped(real[:, [0, 2]])
    counted = [counter.counted(q, now) for q, now in zip(reported, t, strict=True)]
    np.testing.assert_allclose(counted, real, atol=1e-9)


def test_reports_that_count_turns_themselves_are_not_changed(robot: Any) -> None:
    counter = TurnCounter(robot)
    for now in np.arange(0.0, 8.0, PERIOD):
        q = np.array([9.0 + now, 0.1, -7.0 - now])
        assert counter.counted(q, now) is q


def test_the_position_of_a_joint_with_limits_is_never_changed(robot: Any) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([0.0, 3.1, 0.0]), 0.0)
    assert counter.counted(np.array([0.0, -3.1, 0.0]), PERIOD)[1] == -3.1


def test_if_a_joint_may_have_made_half_a_turn_since_its_last_report_the_new_report_is_used_unchanged(
    robot: Any,
) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([3.1, 0.0, 3.1]), 0.0)
    found = counter.counted(np.array([-3.1, 0.0, -3.1]), 0.8)
    assert found[2] == -3.1, "at 4 rad/s half a turn takes 0.785 s"
    assert found[0] == pytest.approx(2.0 * np.pi - 3.1), "at 2 rad/s it takes longer"


def test_a_pause_in_the_reports_of_one_joint_does_not_affect_other_joints(robot: Any) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([3.1, 0.0, 3.1]), np.zeros(3))
    for now in np.arange(PERIOD, 2.0, PERIOD):
        counter.counted(np.array([3.1, 0.0, 3.1]), np.array([0.0, now, now]))
    found = counter.counted(np.array([-3.1, 0.0, -3.1]), np.array([2.0, 2.0, 2.0]))
    assert found[0] == -3.1, "silent for 2 s, in which this joint may have turned by more than half a turn"
    assert found[2] == pytest.approx(2.0 * np.pi - 3.1)


@pytest.mark.parametrize(("reported", "held"), [(-3.1, -3.08), (-3.1, 3.12), (3.12, -3.1)])
def test_the_angle_that_the_drives_hold_is_given_in_the_turn_that_is_nearest_to_the_measured_angle(
    robot: Any, reported: float, held: float
) -> None:
    counter, zero = TurnCounter(robot), np.zeros(3)
    counter.counted(np.array([3.1, 0.0, 0.0]), 0.0)
    state = RobotState(np.array([reported, 9.0, 0.0]), zero, zero, None, PERIOD, np.array([held, -9.0, 0.0]))
    found = counter.of_state(state)
    assert found.held is not None
    assert found.q[0] == pytest.approx(reported % (2.0 * np.pi))
    np.testing.assert_allclose(found.held, [held % (2.0 * np.pi), -9.0, 0.0])
    assert state.held is not None
    assert state.held[0] == held, "the plant's own array is not written to"


def test_a_report_that_is_not_finite_is_passed_on_and_does_not_change_the_count_of_turns(robot: Any) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([3.1, 0.0, 0.0]), 0.0)
    assert np.isnan(counter.counted(np.array([np.nan, 0.0, 0.0]), PERIOD)[0])
    assert counter.counted(np.array([-3.1, 0.0, 0.0]), 2 * PERIOD)[0] == pytest.approx(2.0 * np.pi - 3.1)


def test_a_robot_says_which_of_its_joints_are_continuous() -> None:
    jaco = Robot.from_config(load_config("config/dual_kinova.yaml"))
    assert jaco.endless[:6].tolist() == [True, False, False, True, False, True]
