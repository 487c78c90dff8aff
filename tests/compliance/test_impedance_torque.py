"""The torque of the impedance against its formulas, written out with NumPy and Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.cell import load_config
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState
from tests.support.poses import pose_error
from tests.support.torque_loop import reference

ROBOT = Robot.from_config(load_config("config/dual_iiwa7.yaml"))


def damping(stiffness: Array, inertia: Array, ratio: float) -> Array:
    """2 xi sqrt(K) sqrt(sqrt(K)^-1 Lambda sqrt(K)^-1) sqrt(K), the matrix square root by its eigenvalues."""
    root = np.sqrt(stiffness)
    values, vectors = np.linalg.eigh(inertia / np.outer(root, root))
    return np.asarray(2.0 * ratio * np.outer(root, root) * (vectors @ np.diag(np.sqrt(values)) @ vectors.T))


def arm_torque(
    arm: str, settings: ImpedanceSettings, wanted: tuple[Array, Array], measured: tuple[Array, Array]
) -> Array:
    """Torque (7,) of one arm's spring and posture."""
    model, joints, frame = ROBOT.model, ROBOT.arms[arm].joints, ROBOT.arms[arm].frame_id
    (q_wanted, v_wanted), (q, v) = wanted, measured
    jacobians = []
    for posture in (q, q_wanted):
        data = model.createData()
        pin.computeJointJacobians(model, data, posture)
        jacobians.append(pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:, joints])
    J, J_wanted = jacobians
    M = pin.crba(model, model.createData(), q)[np.ix_(joints, joints)]
    error = pose_error(ROBOT.tool_pose(q_wanted, arm), ROBOT.tool_pose(q, arm))
    for part, most in ((slice(3), settings.max_position_error), (slice(3, 6), settings.max_rotation_error)):
        error[part] *= min(1.0, most / float(np.linalg.norm(error[part])))
    inertia = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    K = np.repeat([settings.translational_stiffness, settings.rotational_stiffness], 3)
    K_posture = settings.nullspace_stiffness
    force = K * error + damping(K, inertia, settings.damping_ratio) @ (J_wanted @ v_wanted[joints] - J @ v[joints])
    posture = K_posture * (q_wanted - q)[joints]
    posture += 2.0 * settings.nullspace_damping_ratio * np.sqrt(K_posture * np.diag(M)) * (v_wanted - v)[joints]
    N = np.eye(7) - J.T @ inertia @ J @ np.linalg.inv(M)
    return np.asarray(J.T @ force + N @ posture)


@pytest.mark.parametrize("spread", [0.02, 0.5], ids=["near", "further than the clip"])
def test_the_torque_is_that_of_the_formulas(spread: float) -> None:
    random = np.random.default_rng(7)
    settings = ImpedanceSettings(damping_ratio=0.7, limit_distance=1e-3, torque_rate_limit=1e5)
    controller = ImpedanceController(ROBOT, settings)
    clipped = 0
    for _ in range(20):
        q = ROBOT.home + random.normal(scale=0.2, size=14)
        v, a, v_wanted = random.normal(scale=0.05, size=(3, 14))
        q_wanted = q + random.uniform(-spread, spread, 14)
        state = RobotState(q, v, np.zeros(14), None, 0.0)
        controller.reset(state)
        # The spring is about the reference of the tick before.
        controller.step(reference(q_wanted, v_wanted), state, 0.001)
        command = controller.step(reference(q_wanted, v_wanted, a), state, 0.1)
        expected = pin.rnea(ROBOT.model, ROBOT.model.createData(), q, v, a)
        for arm, found in ROBOT.arms.items():
            expected[found.joints] += arm_torque(arm, settings, (q_wanted, v_wanted), (q, v))
        expected = np.clip(expected, -ROBOT.torque_limit, ROBOT.torque_limit)
        np.testing.assert_allclose(command.tau, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
        clipped += len(command.report.clipped)
    assert clipped > 10 if spread > 0.1 else clipped == 0
