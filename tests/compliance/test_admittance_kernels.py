from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.admittance_kernels import estimate_wrench, oscillate
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array
from tests.control.cells import cell, random_posture

ROBOT = cell("dual_iiwa7").robot
ARM = ROBOT.arms["left"]
MEMBER = np.isin(np.arange(len(ROBOT.home)), ARM.joints).astype(float)
SCALE = np.array([1.0, 1.0, 1.0, *[ROTATION_LENGTH] * 3])


def _jacobian(q: Array) -> Array:
    data = ROBOT.model.createData()
    pin.computeJointJacobians(ROBOT.model, data, q)
    return np.array(pin.getFrameJacobian(ROBOT.model, data, ARM.frame_id, pin.LOCAL_WORLD_ALIGNED))


def _estimate(q: Array, tau: Array) -> Array:
    wrench = np.zeros(6)
    estimate_wrench(_jacobian(q).copy(), tau, MEMBER, np.zeros((6, 6)), np.zeros((6, 6)), wrench)
    return wrench


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
        tau = random.normal(0.0, 10.0, len(q))
        fitted = np.linalg.pinv(_jacobian(q)[:, ARM.joints].T) @ tau[ARM.joints]
        np.testing.assert_allclose(_estimate(q, tau), fitted, atol=1e-7)


def test_another_arms_torques_change_nothing(regular: list[Array]) -> None:
    tau = np.random.default_rng(44).normal(0.0, 10.0, len(ROBOT.home))
    np.testing.assert_array_equal(_estimate(regular[0], tau), _estimate(regular[0], tau * MEMBER))


def test_stretched_out_the_estimate_stays_bounded_and_knows_nothing_of_the_force_along_the_arm() -> None:
    random, upright = np.random.default_rng(45), np.zeros(len(ROBOT.home))
    assert _least_singular(upright) < 1e-9
    along = np.array([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(_estimate(upright, _jacobian(upright).T @ along), 0.0, atol=1e-9)
    for angle in np.linspace(0.0, 0.3, 60):
        bent = upright.copy()
        bent[3] = angle
        tau = random.uniform(-1.0, 1.0, len(bent))
        # With f(s) = s / (s^2 + e^2 (1 - s^2/e^2)^2) <= 1.16 / e for e = 0.05.
        assert np.linalg.norm(_estimate(bent, tau) / SCALE) <= 1.16 / 0.05 * np.linalg.norm(tau * MEMBER)


def test_the_estimate_changes_gradually_on_the_way_out_of_a_singularity() -> None:
    postures = np.linspace(0.0, 1.0, 4001)[:, None] * ROBOT.home
    tau = np.full(len(ROBOT.home), 1.0)
    estimates = np.array([_estimate(q, tau) for q in postures])
    assert np.abs(np.diff(estimates, axis=0)).max() < 0.2
    assert _least_singular(postures[-1]) > 0.05 > _least_singular(postures[0])


@pytest.mark.parametrize("ratio", [0.1, 0.7, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.3, 5.0])
@pytest.mark.parametrize("dt", [1e-4, 0.01, 0.1])
def test_one_step_of_the_oscillator_is_what_a_thousand_small_ones_come_to(ratio: float, dt: float) -> None:
    frequency, h = 12.0, dt / 1000

    def slope(state: Array) -> Array:
        return np.array([state[1], -2 * ratio * frequency * state[1] - frequency**2 * state[0]])

    state = np.array([0.03, -0.2])
    for _ in range(1000):  # Runge and Kutta's fourth order
        k1 = slope(state)
        k2 = slope(state + h / 2 * k1)
        k3 = slope(state + h / 2 * k2)
        k4 = slope(state + h * k3)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    np.testing.assert_allclose(oscillate(0.03, -0.2, frequency, ratio, dt), state, atol=1e-9)


def test_a_stiff_and_overdamped_oscillator_neither_overflows_nor_grows() -> None:
    x, v = oscillate(0.1, 1.0, 200.0, 5.0, 0.1)
    assert 0.0 < x < 0.2
    assert abs(v) < 1.0
