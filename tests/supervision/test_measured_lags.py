"""The lags of arms, which are found from their measured postures."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.supervision.measured_lags import MeasuredLags
from q2r2_control.types import SIDES, Array

DT = 0.005  # Period of ticks [s].


def swing(robot: Robot, t: float) -> Array:
    """Return the posture at ``t`` [s] of joints that swing at up to 0.6 rad/s. They rest before time 0."""
    return np.asarray(robot.home + 0.3 * (1.0 - np.cos(2.0 * max(t, 0.0))))


def found(robot: Robot, lags: dict[str, float], now: float) -> dict[str, float]:
    """Return the lags that are found at ``now`` [s] for arms whose true lags are ``lags`` [s]."""
    watch, q = MeasuredLags(robot), robot.home.copy()
    for t in np.arange(-0.5, now, DT):
        watch.note(swing(robot, t), float(t))
    for arm, lag in lags.items():
        joints = robot.arms[arm].joints
        q[joints] = swing(robot, now - lag)[joints]
    return watch.behind(q, dict.fromkeys(SIDES, now))


@pytest.mark.parametrize("lags", [(0.03, 0.03), (0.03, 0.1), (0.38, 0.05)])
def test_the_lags_of_moving_arms_are_found_exactly(robot: Robot, lags: tuple[float, float]) -> None:
    wanted = dict(zip(SIDES, lags, strict=True))
    assert found(robot, wanted, 0.8) == pytest.approx(wanted, abs=0.011)


def test_resting_or_reversing_arms_with_the_same_lag_get_nearly_the_same_lag(robot: Robot) -> None:
    same = dict.fromkeys(SIDES, 0.04)
    for now in (-0.1, 0.5 * np.pi, np.pi):
        lags = found(robot, same, float(now))
        assert abs(lags["left"] - lags["right"]) <= 0.011


def test_the_largest_lag_that_is_found_is_0_4_s(robot: Robot) -> None:
    """If an arm is even farther behind its reference, something else has moved it."""
    assert found(robot, dict.fromkeys(SIDES, 0.6), 1.2) == pytest.approx(dict.fromkeys(SIDES, 0.4), abs=0.011)


def test_a_resting_arm_gets_the_same_lag_as_the_moving_arm(robot: Robot) -> None:
    """The posture of the resting arm fits every lag, so the lag of the other arm is used."""
    watch, left = MeasuredLags(robot), robot.arms["left"].joints

    def at(t: float) -> Array:
        q = robot.home.copy()
        q[left] = swing(robot, t)[left]
        return q

    for t in np.arange(0.0, 0.8, DT):
        watch.note(at(t), float(t))
    assert watch.behind(at(0.7), dict.fromkeys(SIDES, 0.8)) == pytest.approx(dict.fromkeys(SIDES, 0.1), abs=0.011)


def test_after_a_restart_earlier_references_give_no_lag(robot: Robot) -> None:
    watch = MeasuredLags(robot)
    watch.note(swing(robot, 0.7), 0.7)
    watch.restart()
    watch.note(swing(robot, 0.9), 0.8)
    assert watch.behind(swing(robot, 0.7), dict.fromkeys(SIDES, 0.8)) == dict.fromkeys(SIDES, 0.0)


def test_without_a_reference_no_arm_has_a_lag(robot: Robot) -> None:
    assert MeasuredLags(robot).behind(robot.home, dict.fromkeys(SIDES, 1.0)) == dict.fromkeys(SIDES, 0.0)
