"""From which friction on a tool that presses on a plane and slides over it chatters by itself.

Friction turns a change of the normal force into one along the slide, and the arm's inertia turns that back: a tool that
is pulled along lifts or dips (the off-diagonal terms of its inertia). Where that adds up, two modes of arm and contact
couple and grow: mode-coupling instability, as in brakes and in chalk that is pushed (Hoffmann et al., "A minimal model
for studying properties of the mode-coupling type instability in friction induced oscillations", 2002). About steady
sliding along t with the normal n

    M q'' + (J' D J + N D_n) q' + (J' K J + N K_n) q + k J' (n - mu t) n' J q = 0,

which is not symmetric for mu > 0. J, M are the arm's, the springs those of the impedance, k the contact's stiffness,
undamped. Coulomb's friction mu does not depend on speed, so the speed of the slide is not in it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.impedance_terms import (
    TermScratch,
    damp,
    take_consistent,
    take_kinematic,
    task_inertia,
)
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_NORMAL = np.array([0.0, 0.0, 1.0])  # of a table
_STEP, _MOST = 0.05, 2.0  # of friction
_GROWS = 1e-6  # [1/s]


def chatter_friction(
    robot: Robot,
    settings: ImpedanceSettings,
    arm: str,
    q: Array,
    direction: Array,
    contact_stiffness: float,
    rotor_share: float = 1.0,
) -> float:
    """Least friction, in steps of 0.05, at which a slide along ``direction`` is unstable; inf above 2.

    ``q`` (nv,) [rad] of all arms, ``direction`` (3,) horizontal in the world, ``contact_stiffness`` [N/m] of a
    horizontal plane under the tool frame's origin, ``rotor_share`` of the rotors' inertia that the joints feel, of
    which the impedance takes all.
    """
    J, M = _jacobian_and_inertia(robot, arm, q)
    joints = robot.arms[arm].joints
    felt = M - (1.0 - rotor_share) * np.diag(robot.model.armature[joints])
    spring, damping = _impedance(settings, J, M)
    along = np.asarray(direction) / np.linalg.norm(direction)
    normal = J[:3].T @ _NORMAL
    for friction in np.arange(0.0, _MOST + _STEP, _STEP):
        contact = contact_stiffness * np.outer(J[:3].T @ (_NORMAL - friction * along), normal)
        if _growth(felt, damping, spring + contact) > _GROWS:
            return round(float(friction), 2)
    return np.inf


def _jacobian_and_inertia(robot: Robot, arm: str, q: Array) -> tuple[Array, Array]:
    """Of one arm's joints, (6, n) in world axes and (n, n) with all of the rotors."""
    data, chosen = robot.model.createData(), robot.arms[arm]
    pin.computeJointJacobians(robot.model, data, q)
    pin.updateFramePlacements(robot.model, data)
    J = pin.getFrameJacobian(robot.model, data, chosen.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, chosen.joints]
    M = np.triu(pin.crba(robot.model, data, q))
    M += np.triu(M, 1).T
    return np.ascontiguousarray(J), np.ascontiguousarray(M[np.ix_(chosen.joints, chosen.joints)])


def _impedance(settings: ImpedanceSettings, J: Array, M: Array) -> tuple[Array, Array]:
    """Stiffness and damping (n, n) of the joints by the impedance."""
    terms, inertia, M_inverse = TermScratch.empty(len(M)), np.zeros((6, 6)), np.linalg.inv(M)
    task_inertia(J @ M_inverse @ J.T, terms, inertia)
    stiffness = np.repeat([settings.translational_stiffness, settings.rotational_stiffness], 3)
    posture = np.full(len(M), settings.nullspace_stiffness)

    def projected(torque: Array) -> None:
        if settings.nullspace_projector == "consistent":
            take_consistent(J, inertia, J @ M_inverse @ torque, torque, terms)
        else:
            take_kinematic(J, torque, terms)

    N = _matrix_of(projected, len(M))
    damping = _matrix_of(lambda rate: damp(stiffness, inertia, settings.damping_ratio, rate, terms), 6)
    posture_damping = _matrix_of(lambda rate: damp(posture, M, settings.nullspace_damping_ratio, rate, terms), len(M))
    return J.T @ np.diag(stiffness) @ J + N @ np.diag(posture), J.T @ damping @ J + N @ posture_damping


def _matrix_of(change: Callable[[Array], None], n: int) -> Array:
    """The matrix (n, n) by which a linear law changes a vector in its place."""
    columns = np.eye(n)
    for column in columns:
        change(column)
    return columns.T


def _growth(inertia: Array, damping: Array, stiffness: Array) -> float:
    """Greatest real part of the eigenvalues of M q'' + D q' + K q = 0 [1/s]."""
    n = len(inertia)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.eye(n)
    A[n:] = -np.linalg.solve(inertia, np.hstack([stiffness, damping]))
    return float(np.linalg.eigvals(A).real.max())
