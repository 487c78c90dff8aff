"""The torque of a commanded stop agrees with inverse dynamics for every combination of signs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import stop_torques
from tests.robot.conftest import one_arm

FAST = np.full(7, 10.0)  # No iiwa 7 has enough torque for this acceleration [rad/s^2].
UNEQUAL = np.array([8.0, 5.0, 6.0, 10.0, 11.0, 12.0, 13.0])


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(one_arm(tool={"model": "hand_e"}))


def test_the_reported_torque_is_the_largest_one_over_all_signs_of_the_decelerations(robot: Robot) -> None:
    (stop,) = stop_torques(robot, UNEQUAL, postures=1, seed=1)
    data, q, rest = robot.model.createData(), np.array(stop.stop.posture), np.zeros(7)
    signs = np.array(list(product((-1.0, 1.0), repeat=7)))
    asked = np.abs([pin.rnea(robot.model, data, q, rest, UNEQUAL * row) for row in signs]) / robot.torque_limit
    assert stop.stop.ratio == pytest.approx(asked.max(), rel=1e-9)
    assert stop.stop.joint == robot.joint_names[asked.max(axis=0).argmax()]
    assert stop.stop.share_over == (asked.max() > 1.0)
    np.testing.assert_allclose([joint.stop for joint in stop.joints], asked.max(axis=0), rtol=1e-9)
    assert [joint.acceleration for joint in stop.joints] == UNEQUAL.tolist()
    assert [joint.joint for joint in stop.joints] == list(robot.joint_names)
    at_rest = np.abs(pin.computeGeneralizedGravity(robot.model, data, q)) / robot.torque_limit
    np.testing.assert_allclose([joint.gravity for joint in stop.joints], at_rest, rtol=1e-9)
    assert (stop.gravity.ratio, stop.gravity.posture) == (pytest.approx(at_rest.max()), stop.stop.posture)


def test_the_figure_share_over_is_zero_exactly_for_bearable_decelerations(robot: Robot) -> None:
    (stop,) = stop_torques(robot, FAST, postures=1000)
    assert 0.05 < stop.stop.share_over < 0.15
    assert 0.0 < stop.bearable < 1.0
    assert stop_torques(robot, 0.999 * stop.bearable * FAST, postures=1000)[0].stop.share_over == 0.0
    assert stop_torques(robot, 1.001 * stop.bearable * FAST, postures=1000)[0].stop.share_over == 0.001


def test_the_torque_that_gravity_needs_is_reported_separately_from_the_torque_of_a_stop(robot: Robot) -> None:
    weak = Robot.from_config(one_arm(tool={"model": "hand_e"}))
    weak.torque_limit[3] = 5.0
    (stop,) = stop_torques(weak, FAST, postures=1000)
    assert (stop.gravity.joint, stop.bearable) == ("left_A4", 0.0)
    assert stop.gravity.ratio > 1.0
    assert 0.0 < stop.gravity.share_over < stop.stop.share_over
    assert stop_torques(robot, FAST, postures=1000)[0].gravity.share_over == 0.0


def test_no_full_stop_at_the_limits_of_the_shipped_cells_needs_more_torque_than_a_joint_has(dual_iiwa: Robot) -> None:
    """The same holds for the models' own limits, which count if control.acceleration_limit is higher."""
    for acceleration in (dual_iiwa.capped_acceleration(10.0), dual_iiwa.acceleration_limit):
        assert max(stop.stop.ratio for stop in stop_torques(dual_iiwa, acceleration, postures=1000)) < 0.9
