"""How far arms are behind, found in where they are measured."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.supervision.measured_lags import MeasuredLags
from q2r2_control.types import SIDES, Array

DT = 0.005  # of ticks [s]


def swing(robot: Robot, t: float) -> Array:
    """All joints to and fro, up to 0.6 rad/s; they rest before 0."""
    return np.asarray(robot.home + 0.3 * (1.0 - np.cos(2.0 * max(t, 0.0))))


def found(robot: Robot, lags: dict[str, float], now: float) -> dict[str, float]:
    """The lags that are found at ``now`` [s] of arms that have some."""
    watch, q = MeasuredLags(robot), robot.home.copy()
    for t in np.arange(-0.5, now, DT):
        watch.note(swing(robot, t), float(t))
    for arm, lag in lags.items():
        joints = robot.arms[arm].joints
        q[joints] = swing(robot, now - lag)[joints]
    return watch.behind(q, dict.fromkeys(SIDES, now))


@pytest.mark.parametrize("lags", [(0.03, 0.03), (0.03, 0.1), (0.2, 0.05)])
def test_arms_on_their_way_are_found_as_far_behind_as_they_are(robot: Robot, lags: tuple[float, float]) -> None:
    wanted = dict(zip(SIDES, lags, strict=True))
    assert found(robot, wanted, 0.8) == pytest.approx(wanted, abs=0.011)


def test_arms_that_rest_and_turn_are_no_farther_apart_than_must_be(robot: Robot) -> None:
    same = dict.fromkeys(SIDES, 0.04)
    for now in (-0.1, 0.5 * np.pi, np.pi):
        lags = found(robot, same, float(now))
        assert abs(lags["left"] - lags["right"]) <= 0.011


def test_without_a_reference_no_arm_is_behind(robot: Robot) -> None:
    assert MeasuredLags(robot).behind(robot.home, dict.fromkeys(SIDES, 1.0)) == dict.fromkeys(SIDES, 0.0)
