"""The torque of a commanded stop, against inverse dynamics with every combination of signs."""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import stop_torques
from tests.robot.conftest import one_arm

ACCELERATION = 10.0


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(one_arm(tool={"model": "hand_e"}))


@pytest.mark.parametrize("seed", range(5))
def test_the_torque_is_the_most_that_any_signs_of_the_decelerations_ask_for(robot: Robot, seed: int) -> None:
    (stop,) = stop_torques(robot, ACCELERATION, postures=1, seed=seed)
    data, q, rest = robot.model.createData(), np.array(stop.posture), np.zeros(7)
    asked = np.array(
        [
            np.abs(pin.rnea(robot.model, data, q, rest, ACCELERATION * np.array(signs))) / robot.torque_limit
            for signs in product((-1.0, 1.0), repeat=7)
        ]
    )
    assert stop.ratio == pytest.approx(asked.max(), rel=1e-9)
    assert stop.joint == robot.joint_names[asked.max(axis=0).argmax()]
    assert stop.share_over == (asked.max() > 1.0)


def test_the_share_and_what_is_bearable_agree(robot: Robot) -> None:
    (stop,) = stop_torques(robot, ACCELERATION, postures=1000)
    assert 0.05 < stop.share_over < 0.15
    assert 0.0 < stop.bearable < ACCELERATION
    assert stop_torques(robot, 0.999 * stop.bearable, postures=1000)[0].share_over == 0.0
    assert stop_torques(robot, 1.001 * stop.bearable, postures=1000)[0].share_over == 0.001


def test_each_arm_is_judged_by_its_own_joints(dual_iiwa: Robot) -> None:
    left, right = stop_torques(dual_iiwa, ACCELERATION, postures=1000)
    for arm, stop in (("left", left), ("right", right)):
        assert stop.arm == arm
        assert stop.joint == f"{arm}_A2"
        assert len(stop.posture) == 7
        assert (stop.ratio > 1.0) == (dual_iiwa.name == "dual_iiwa7")
        assert (stop.share_over > 0.0) == (dual_iiwa.name == "dual_iiwa7")
