"""The law of the impedance, compiled: see :class:`ImpedanceController`; its pieces stand in compliance.py.

Inertia and feed-forward come in from Pinocchio, torque goes out. One call for all arms, since a dozen NumPy calls on
matrices of seven rows cost more than the work they do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.compliance.impedance_terms import (
    clip_error,
    consistent_projector,
    double_diagonalised_damping,
    kinematic_projector,
    limit_repulsion,
    task_inertia,
)
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements, place
from q2r2_control.control.jit import Held, kernel
from q2r2_control.control.tasks.frame import Tools, rotation_vector, tool_jacobian, tool_pose
from q2r2_control.types import Array


class Springs(NamedTuple):
    """What does not change between ticks; k arms of at most m joints."""

    chain: Chain
    tools: Tools
    joints: IntArray  # (k, m) of each arm, the first ``dofs`` of a row
    dofs: IntArray  # (k,)
    lower: Array  # (nv,) position limits [rad]
    upper: Array  # (nv,)
    limit_stiffness: float
    limit_damping: float
    limit_distance: float
    damping_ratio: float
    posture_stiffness: float
    posture_damping_ratio: float
    max_position_error: float
    max_rotation_error: float
    consistent: bool  # which nullspace projector


class Pull(NamedTuple):
    """One tick: what was measured, what is wanted, and what comes of it. World axes at the tools' origins."""

    q: Array  # (nv,) measured
    v: Array  # (nv,)
    wanted_q: Array  # (nv,)
    wanted_v: Array  # (nv,)
    M: Array  # (nv, nv)
    M_inverse: Array  # (nv, nv)
    stiffness: Array  # (k, 2) in force [N/m, Nm/rad]
    errors: Array  # (k, 6) after clipping
    clipped: IntArray  # (k,) 1 where it was longer
    repulsion: Array  # (nv,) from position limits [Nm]
    tau: Array  # (nv,) in: feed-forward; out: with springs and repulsion [Nm]
    placements: Placements  # scratch, as all below: of the links at q
    wanted_placements: Placements
    rotation: Array  # (2, 3, 3) of one tool: at q, at wanted_q
    translation: Array  # (2, 3)
    J: Array  # (2, 6, nv)

    @classmethod
    def empty(cls, springs: Springs) -> Pull:
        arms, nv = len(springs.dofs), len(springs.lower)
        return cls(
            q=np.zeros(nv),
            v=np.zeros(nv),
            wanted_q=np.zeros(nv),
            wanted_v=np.zeros(nv),
            M=np.eye(nv),
            M_inverse=np.eye(nv),
            stiffness=np.ones((arms, 2)),
            errors=np.zeros((arms, 6)),
            clipped=np.zeros(arms, dtype=np.int64),
            repulsion=np.zeros(nv),
            tau=np.zeros(nv),
            placements=Placements.empty(springs.chain),
            wanted_placements=Placements.empty(springs.chain),
            rotation=np.zeros((2, 3, 3)),
            translation=np.zeros((2, 3)),
            J=np.zeros((2, 6, nv)),
        )


@kernel
def pull_arms(held_springs: Held, held_pull: Held) -> None:
    """Add every arm's spring, posture and repulsion from limits to ``tau``.

    Raises :class:`numpy.linalg.LinAlgError` where the numbers are too large to be computed with.
    """
    springs, pull = held_springs.value, held_pull.value
    pull.repulsion[:] = limit_repulsion(
        pull.q,
        pull.v,
        pull.wanted_q,
        springs.lower,
        springs.upper,
        springs.limit_stiffness,
        springs.limit_damping,
        springs.limit_distance,
    )
    pull.tau[:] += pull.repulsion
    place(springs.chain, pull.q, pull.placements)
    place(springs.chain, pull.wanted_q, pull.wanted_placements)
    for i in range(springs.dofs.shape[0]):
        joints = springs.joints[i, : springs.dofs[i]]
        torque = _arm_torque(springs, pull, i, joints)
        for k in range(joints.shape[0]):
            pull.tau[joints[k]] += torque[k]


@kernel
def _arm_torque(springs: Springs, pull: Pull, i: int, joints: IntArray) -> Array:
    """Torque (n,) of one arm's spring and posture; writes its clipped error."""
    error = _look(springs, pull, i)
    J, wanted_J = pull.J[0][:, joints], pull.J[1][:, joints]
    way, speed = (pull.wanted_q - pull.q)[joints], (pull.wanted_v - pull.v)[joints]
    M, M_inverse = pull.M[joints][:, joints], pull.M_inverse[joints][:, joints]
    error, was_clipped = clip_error(error, springs.max_position_error, springs.max_rotation_error)
    pull.errors[i], pull.clipped[i] = error, was_clipped
    error_rate = wanted_J @ pull.wanted_v[joints] - J @ pull.v[joints]
    tool_inertia = task_inertia(J, M_inverse)
    stiffness = np.repeat(pull.stiffness[i], 3)
    damping = double_diagonalised_damping(stiffness, tool_inertia, springs.damping_ratio)
    posture_stiffness = np.full(len(joints), springs.posture_stiffness)
    posture_damping = double_diagonalised_damping(posture_stiffness, M, springs.posture_damping_ratio)
    posture = posture_stiffness * way + posture_damping @ speed
    N = consistent_projector(J, M_inverse, tool_inertia) if springs.consistent else kinematic_projector(J)
    return J.T @ (stiffness * error + damping @ error_rate) + N @ posture


@kernel
def _look(springs: Springs, pull: Pull, i: int) -> Array:
    """Way (6,) from the measured to the wanted pose of tool ``i``, as :func:`pose_error`; writes both Jacobians."""
    chain, tools, rotation, translation = springs.chain, springs.tools, pull.rotation, pull.translation
    tool_pose(pull.placements, tools, i, rotation[0], translation[0])
    tool_pose(pull.wanted_placements, tools, i, rotation[1], translation[1])
    tool_jacobian(chain, pull.placements, tools, i, translation[0], pull.J[0])
    tool_jacobian(chain, pull.wanted_placements, tools, i, translation[1], pull.J[1])
    error = np.empty(6)
    error[:3] = translation[1] - translation[0]
    rotation_vector(rotation[1] @ rotation[0].T, error[3:])
    return error
