"""Endless joints whose angle is reported within one turn: their positions go on, and nothing else is changed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turns import TurnCounter
from q2r2_control.types import Array

PERIOD = 0.01  # [s]


@pytest.fixture
def robot() -> Any:
    """Three joints, of which the middle one ends and the others turn on for ever."""
    return SimpleNamespace(endless=np.array([True, False, True]), velocity_limit=np.array([2.0, 2.0, 4.0]))


def wrapped(angle: Array) -> Array:
    return np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi


def test_positions_go_on_where_reports_begin_anew_at_half_a_turn(robot: Any) -> None:
    counter, t = TurnCounter(robot), np.arange(0.0, 12.0, PERIOD)
    real = np.stack([1.9 * t - 1.0, np.sin(t), -1.7 * t], axis=1)
    reported = real.copy()
    reported[:, [0, 2]] = wrapped(real[:, [0, 2]])
    counted = [counter.counted(q, now) for q, now in zip(reported, t, strict=True)]
    np.testing.assert_allclose(counted, real, atol=1e-9)


def test_reports_that_count_turns_themselves_stay_as_they_are(robot: Any) -> None:
    counter = TurnCounter(robot)
    for now in np.arange(0.0, 8.0, PERIOD):
        q = np.array([9.0 + now, 0.1, -7.0 - now])
        assert counter.counted(q, now) is q


def test_a_joint_that_ends_is_never_turned(robot: Any) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([0.0, 3.1, 0.0]), 0.0)
    assert counter.counted(np.array([0.0, -3.1, 0.0]), PERIOD)[1] == -3.1


def test_after_a_gap_in_which_a_joint_may_have_turned_by_half_the_report_is_believed(robot: Any) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([3.1, 0.0, 0.0]), 0.0)
    assert counter.counted(np.array([-3.1, 0.0, 0.0]), 0.8)[0] == -3.1, "at 4 rad/s half a turn takes 0.785 s"


def test_a_report_without_a_number_is_left_for_others_to_judge_and_forgets_nothing(robot: Any) -> None:
    counter = TurnCounter(robot)
    counter.counted(np.array([3.1, 0.0, 0.0]), 0.0)
    assert np.isnan(counter.counted(np.array([np.nan, 0.0, 0.0]), PERIOD)[0])
    assert counter.counted(np.array([-3.1, 0.0, 0.0]), 2 * PERIOD)[0] == pytest.approx(2.0 * np.pi - 3.1)


def test_a_robot_knows_its_endless_joints() -> None:
    jaco = Robot.from_config(load_config("config/dual_kinova.yaml"))
    assert jaco.endless[:6].tolist() == [True, False, False, True, False, True]
