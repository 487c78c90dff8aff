"""The formulas of the impedance, each tested alone: damping, inertia, projectors and the bounds of the torque."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.compliance.impedance_law import (
    PositionLimits,
    bound_torque,
    clip_errors,
    consistent_force,
    inertia_and_damping,
    limit_repulsion,
)
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState
from tests.support.torque_loop import left_arm, pose_error, reference

ROBOT = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
STRETCHED = np.zeros(14)
STIFFNESS = np.array([2000.0] * 3 + [200.0] * 3)


def tool_inertia(J: Array, M: Array) -> Array:
    """Return the inertia of the tool (6, 6)."""
    inertia: Array = inertia_and_damping(J @ np.linalg.solve(M, J.T), STIFFNESS)[0]
    return inertia


def projector_of(J: Array, M: Array) -> Array:
    """Return the nullspace projector N (n, n). Each column is the projection of a unit torque."""
    J, inertia, M_inverse = np.ascontiguousarray(J), tool_inertia(J, M), np.linalg.inv(M)
    consistent = [torque - J.T @ consistent_force(inertia, J, M_inverse, torque) for torque in np.eye(len(M))]
    return np.column_stack(consistent)


def test_translation_and_rotation_of_an_error_are_each_clipped_in_length_and_keep_their_direction() -> None:
    errors = np.array(
        [[0.03, 0.0, 0.04, 0.0, 0.3, 0.4], [0.3, 0.0, 0.4, 0.0, 0.3, 0.0], [0.0, 0.0, 0.01, 3.0, 0.0, 0.0]]
    )
    expected = errors * [[1.0] * 6, [*[0.2] * 3, *[1.0] * 3], [*[1.0] * 3, *[1.0 / 6.0] * 3]]
    assert clip_errors(errors, 0.1, 0.5).tolist() == [False, True, True]
    np.testing.assert_allclose(errors, expected, atol=1e-15)


class TestASingularPosture:
    @pytest.mark.slow
    def test_the_inertia_of_the_tool_is_at_most_1000_kg_in_any_direction(self) -> None:
        J, M = left_arm(ROBOT, STRETCHED)
        assert np.linalg.matrix_rank(J) < 6
        root = np.sqrt(STIFFNESS / STIFFNESS[0])
        heaviest = np.linalg.eigvalsh(tool_inertia(J, M) / np.outer(root, root)).max()
        assert heaviest == pytest.approx(1000.0)

    def test_near_a_singular_posture_the_projector_does_not_jump_and_its_entries_are_bounded(self) -> None:
        projectors = []
        for bend in np.linspace(-0.02, 0.02, 41):
            q = STRETCHED.copy()
            q[3] = bend
            projectors.append(projector_of(*left_arm(ROBOT, q)))
        assert np.abs(projectors).max() < 10.0
        assert np.abs(np.diff(np.array(projectors), axis=0)).max() < 0.1


class TestLimitRepulsion:
    LIMITS = PositionLimits(np.full(3, -1.0), np.full(3, 1.0), stiffness=300.0, damping=20.0, distance=0.1)

    def torque(self, q: float, v: float = 0.0, wanted: float = 0.0) -> float:
        torques = limit_repulsion(self.LIMITS, np.full(3, q), np.full(3, v), np.full(3, wanted))
        assert np.ptp(torques) == 0
        return float(torques[0])

    def test_the_limit_torque_is_a_spring_that_starts_0_1_rad_before_the_limit_or_at_a_reference_nearer_to_it(
        self,
    ) -> None:
        assert [self.torque(q) for q in (-0.9, 0.0, 0.9)] == [0.0, 0.0, 0.0]
        assert [self.torque(q) for q in (0.95, -0.95, 1.1)] == pytest.approx([-15.0, 15.0, -60.0])
        assert [self.torque(q, wanted=0.97) for q in (0.97, 0.98)] == pytest.approx([0.0, -3.0])
        assert self.torque(-0.98, wanted=-0.97) == pytest.approx(3.0)

    def test_the_limit_torque_brakes_motion_towards_the_limit_and_not_motion_away_from_it(self) -> None:
        assert [self.torque(0.95, v=v) for v in (1.0, -1.0, -3.0)] == pytest.approx([-25.0, -5.0, 0.0])
        assert self.torque(-0.95, v=3.0) == 0.0

    def test_the_limit_torque_never_jumps(self) -> None:
        torques = [self.torque(q, v=0.5) for q in np.linspace(0.8, 1.1, 3001)]
        assert np.abs(np.diff(torques)).max() < 0.05


def test_the_bounds_on_the_torque_and_on_its_change_hold_for_any_wanted_torque() -> None:
    random = np.random.default_rng(5)
    limit = np.array([176.0, 110.0, 40.0])
    bounded = np.zeros(3)
    ever_saturated = np.zeros(3, dtype=bool)
    for _ in range(5000):
        last = bounded
        wanted = random.choice([-1e300, -1e3, -50.0, 0.0, 50.0, 1e3, 1e300], 3) * random.random(3)
        change = random.choice([0.0, 1.0, 5.0, 1e9])
        bounded, saturated, late = bound_torque(wanted, last, limit, change)
        assert (np.abs(bounded) <= limit).all()
        assert (np.abs(bounded - last) <= change * (1 + 1e-12)).all()
        free = ~(saturated | late)
        np.testing.assert_array_equal(bounded[free], wanted[free])
        ever_saturated |= saturated & ~late
    assert ever_saturated.all()


def damping(stiffness: Array, inertia: Array, ratio: float) -> Array:
    """Return 2 xi sqrt(K) sqrt(sqrt(K)^-1 Lambda sqrt(K)^-1) sqrt(K), with matrix square roots by eigenvalues."""
    root = np.sqrt(stiffness)
    values, vectors = np.linalg.eigh(inertia / np.outer(root, root))
    return np.asarray(2.0 * ratio * np.outer(root, root) * (vectors @ np.diag(np.sqrt(values)) @ vectors.T))


def arm_torque(
    arm: str, settings: ImpedanceSettings, wanted: tuple[Array, Array], measured: tuple[Array, Array]
) -> Array:
    """Return the torque (7,) [Nm] of one arm, computed from the formulas of the papers.

    It is the torque of the Cartesian impedance plus the torque of the null-space impedance.
    """
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
def test_the_torque_of_the_controller_equals_the_torque_of_the_formulas_in_the_papers(spread: float) -> None:
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
        # The spring acts about the reference of the previous tick.
        controller.step(reference(q_wanted, v_wanted), state, 0.001)
        command = controller.step(reference(q_wanted, v_wanted, a), state, 0.1)
        expected = pin.rnea(ROBOT.model, ROBOT.model.createData(), q, v, a)
        for arm, found in ROBOT.arms.items():
            expected[found.joints] += arm_torque(arm, settings, (q_wanted, v_wanted), (q, v))
        expected = np.clip(expected, -ROBOT.torque_limit, ROBOT.torque_limit)
        np.testing.assert_allclose(command.tau, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
        clipped += len(command.report.clipped)
    assert clipped > 10 if spread > 0.1 else clipped == 0
