from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.admittance import estimate_wrench, oscillate
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array
from tests.control.cells import cell, random_posture

ROBOT = cell("dual_iiwa7").robot
ARM = ROBOT.arms["left"]
SCALE = np.array([1.0, 1.0, 1.0, *[ROTATION_LENGTH] * 3])


def _jacobian(q: Array) -> Array:
    """Of the left arm's joints (6, 7)."""
    data = ROBOT.model.createData()
    return np.array(
        pin.computeFrameJacobian(ROBOT.model, data, q, ARM.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, ARM.joints]
    )


def _estimate(q: Array, tau: Array) -> Array:
    return estimate_wrench(_jacobian(q), tau)


def _least_singular(q: Array) -> float:
    return float(np.linalg.svd(SCALE[:, None] * _jacobian(q))[1][-1])


@pytest.fixture(scope="module")
def regular() -> list[Array]:
    random = np.random.default_rng(41)
    postures = [random_posture(ROBOT, random) for _ in range(200)]
    return [ROBOT.home, *(q for q in postures if _least_singular(q) > 0.05)]


def test_a_wrench_at_the_tool_is_found_again_in_every_posture_that_is_not_singular(regular: list[Array]) -> None:
    random = np.random.default_rng(42)
    assert len(regular) > 50
    for q in regular:
        wrench = random.normal(0.0, [20.0, 20.0, 20.0, 5.0, 5.0, 5.0])
        np.testing.assert_allclose(_estimate(q, _jacobian(q).T @ wrench), wrench, atol=1e-8)


def test_torques_that_no_wrench_explains_give_the_least_squares_wrench(regular: list[Array]) -> None:
    random = np.random.default_rng(43)
    for q in regular:
        tau = random.normal(0.0, 10.0, 7)
        np.testing.assert_allclose(_estimate(q, tau), np.linalg.pinv(_jacobian(q).T) @ tau, atol=1e-7)


def test_stretched_out_the_estimate_stays_bounded_and_knows_nothing_of_the_force_along_the_arm() -> None:
    random, upright = np.random.default_rng(45), np.zeros(len(ROBOT.home))
    assert _least_singular(upright) < 1e-9
    along = np.array([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(_estimate(upright, _jacobian(upright).T @ along), 0.0, atol=1e-9)
    for angle in np.linspace(0.0, 0.3, 60):
        bent = upright.copy()
        bent[3] = angle
        tau = random.uniform(-1.0, 1.0, 7)
        # With f(s) = s / (s^2 + e^2 (1 - s^2/e^2)^2) <= 1.16 / e for e = 0.05.
        assert np.linalg.norm(_estimate(bent, tau) / SCALE) <= 1.16 / 0.05 * np.linalg.norm(tau)


def test_the_estimate_changes_gradually_on_the_way_out_of_a_singularity() -> None:
    postures = np.linspace(0.0, 1.0, 4001)[:, None] * ROBOT.home
    estimates = np.array([_estimate(q, np.ones(7)) for q in postures])
    assert np.abs(np.diff(estimates, axis=0)).max() < 0.2
    assert _least_singular(postures[-1]) > 0.05 > _least_singular(postures[0])


@pytest.mark.parametrize("ratio", [0.1, 1.0 - 1e-9, 1.0, 1.3])
def test_one_step_of_the_oscillator_is_what_a_thousand_small_ones_come_to(ratio: float) -> None:
    start, many = np.array([0.03]), np.array([0.03])
    x, v = oscillate(start, np.array([-0.2]), 12.0, ratio, 0.1)
    # The slope of each small step is that of the differential equation.
    speed, h = np.array([-0.2]), 1e-4
    for _ in range(1000):
        acceleration = -2 * ratio * 12.0 * speed - 144.0 * many
        jerk = -2 * ratio * 12.0 * acceleration - 144.0 * speed
        many = many + h * speed + h**2 / 2 * acceleration
        speed = speed + h * acceleration + h**2 / 2 * jerk
    np.testing.assert_allclose((x, v), (many, speed), atol=1e-6)


def test_a_stiff_and_overdamped_oscillator_neither_overflows_nor_grows() -> None:
    x, v = oscillate(np.array([0.1]), np.array([1.0]), 200.0, 5.0, 0.1)
    assert 0.0 < x < 0.2
    assert abs(v) < 1.0
