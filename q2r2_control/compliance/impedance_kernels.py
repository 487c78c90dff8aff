"""The law of the impedance, compiled: see :class:`ImpedanceController`; its pieces stand in impedance_terms.py.

Inertia and feed-forward come in from Pinocchio, torque goes out. One call for all arms, since a dozen NumPy calls on
matrices of seven rows cost more than the work they do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.compliance.impedance_terms import (
    BoolArray,
    PositionLimits,
    bound_torque,
    clip_error,
    consistent_projector,
    double_diagonalised_damping,
    kinematic_projector,
    limit_repulsion,
    task_inertia,
)
from q2r2_control.compliance.small_matrices import invert, times
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements, place
from q2r2_control.control.jit import Held, kernel, lean_kernel
from q2r2_control.control.tasks.frame import rotation_vector, tool_jacobian, tool_pose
from q2r2_control.control.tasks.task_model import Tools
from q2r2_control.types import Array


class ImpedanceModel(NamedTuple):
    """What does not change between ticks; k arms of at most m joints."""

    chain: Chain
    tools: Tools
    joints: IntArray  # (k, m) of each arm, the first ``dofs`` of a row
    dofs: IntArray  # (k,)
    torque_limit: Array  # (nv,) [Nm]
    limits: PositionLimits
    max_position_error: float  # [m]
    max_rotation_error: float  # [rad]
    consistent: bool  # which nullspace projector


class ToolState(NamedTuple):
    """One tool at one posture of all joints. World axes at its origin."""

    placements: Placements  # of the joint frames
    rotation: Array  # (3, 3)
    translation: Array  # (3,) [m]
    J: Array  # (6, nv)

    @classmethod
    def empty(cls, chain: Chain) -> ToolState:
        nv = len(chain.parent) - 1
        return cls(Placements.empty(chain), np.zeros((3, 3)), np.zeros(3), np.zeros((6, nv)))


class ImpedanceData(NamedTuple):
    """One tick: what was measured, what is wanted, and what comes of it. World axes at the tools' origins."""

    q: Array  # (nv,) measured [rad]
    v: Array  # (nv,) [rad/s]
    wanted_q: Array  # (nv,)
    wanted_v: Array  # (nv,)
    M: Array  # (nv, nv)
    M_inverse: Array  # (nv, nv) scratch
    M_factor: Array  # (nv, nv) scratch
    springs: Array  # (k, 5) in force: the values of LIVE_IMPEDANCE [N/m, Nm/rad, 1, Nm/rad, 1]
    errors: Array  # (k, 6) after clipping [m, rad]
    clipped: IntArray  # (k,) 1 where it was longer
    repulsion: Array  # (nv,) from position limits [Nm]
    tau: Array  # (nv,) in: feed-forward; out: with springs and repulsion [Nm]
    bounded: Array  # (nv,) in: commanded last; out: what of tau is commanded now [Nm]
    saturated: BoolArray  # (nv,)
    rate_limited: BoolArray  # (nv,)
    measured: ToolState  # scratch: of one tool at q
    wanted: ToolState  # scratch: at wanted_q

    @classmethod
    def empty(cls, model: ImpedanceModel) -> ImpedanceData:
        arms, nv = len(model.dofs), len(model.limits.lower)
        return cls(
            q=np.zeros(nv),
            v=np.zeros(nv),
            wanted_q=np.zeros(nv),
            wanted_v=np.zeros(nv),
            M=np.eye(nv),
            M_inverse=np.eye(nv),
            M_factor=np.eye(nv),
            springs=np.ones((arms, 5)),
            errors=np.zeros((arms, 6)),
            clipped=np.zeros(arms, dtype=np.int64),
            repulsion=np.zeros(nv),
            tau=np.zeros(nv),
            bounded=np.zeros(nv),
            saturated=np.zeros(nv, dtype=np.bool_),
            rate_limited=np.zeros(nv, dtype=np.bool_),
            measured=ToolState.empty(model.chain),
            wanted=ToolState.empty(model.chain),
        )


@kernel
def add_impedance_torque(held_model: Held, held_data: Held) -> None:
    """Add every arm's spring, posture and repulsion from limits to ``tau``.

    Raises :class:`numpy.linalg.LinAlgError` where the numbers are too large to be computed with.
    """
    model, data = held_model.value, held_data.value
    if not invert(data.M, data.M_factor, data.M_inverse):
        raise np.linalg.LinAlgError("the inertia matrix is not positive definite")
    data.repulsion[:] = limit_repulsion(model.limits, data.q, data.v, data.wanted_q)
    data.tau[:] += data.repulsion
    place(model.chain, data.q, data.measured.placements)
    place(model.chain, data.wanted_q, data.wanted.placements)
    for i in range(model.dofs.shape[0]):
        joints = model.joints[i, : model.dofs[i]]
        torque = _arm_torque(model, data, i, joints)
        for k in range(joints.shape[0]):
            data.tau[joints[k]] += torque[k]


@kernel
def bound_torques(held_model: Held, held_data: Held, change: float) -> int:
    """Bring ``tau`` within its limits and ``change`` [Nm] of the last command; how many bounds held it back."""
    model, data = held_model.value, held_data.value
    within = bound_torque(data.tau, data.bounded, model.torque_limit, change)
    data.bounded[:], data.saturated[:], data.rate_limited[:] = within
    return data.saturated.sum() + data.rate_limited.sum()


@kernel
def _arm_torque(model: ImpedanceModel, data: ImpedanceData, i: int, joints: IntArray) -> Array:
    """Torque (n,) of one arm's spring and posture; writes its clipped error."""
    error = _tool_error(model, data, i)
    J, wanted_J = data.measured.J[:, joints], data.wanted.J[:, joints]
    way, speed = (data.wanted_q - data.q)[joints], (data.wanted_v - data.v)[joints]
    M, M_inverse = data.M[joints][:, joints], data.M_inverse[joints][:, joints]
    error, was_clipped = clip_error(error, model.max_position_error, model.max_rotation_error)
    data.errors[i], data.clipped[i] = error, was_clipped
    error_rate = times(wanted_J, data.wanted_v[joints]) - times(J, data.v[joints])
    tool_inertia = task_inertia(J, M_inverse)
    linear, angular, damping_ratio, posture, posture_damping_ratio = data.springs[i]
    stiffness = np.array([linear, linear, linear, angular, angular, angular])
    damping = double_diagonalised_damping(stiffness, tool_inertia, damping_ratio)
    posture_stiffness = np.full(len(joints), posture)
    posture_damping = double_diagonalised_damping(posture_stiffness, M, posture_damping_ratio)
    posture_torque = posture_stiffness * way + times(posture_damping, speed)
    N = consistent_projector(J, M_inverse, tool_inertia) if model.consistent else kinematic_projector(J)
    return times(J.T, stiffness * error + times(damping, error_rate)) + times(N, posture_torque)


@kernel
def _tool_error(model: ImpedanceModel, data: ImpedanceData, i: int) -> Array:
    """Way (6,) from the measured to the wanted pose of tool ``i``; writes both Jacobians."""
    measured, wanted = data.measured, data.wanted
    _update_tool(model, i, measured)
    _update_tool(model, i, wanted)
    error = np.empty(6)
    error[:3] = wanted.translation - measured.translation
    rotation_vector(wanted.rotation @ measured.rotation.T, error[3:])
    return error


@lean_kernel
def _update_tool(model: ImpedanceModel, i: int, tool: ToolState) -> None:
    """Pose and Jacobian of tool ``i`` where the joint frames are placed."""
    tool_pose(tool.placements, model.tools, i, tool.rotation, tool.translation)
    tool_jacobian(model.chain, tool.placements, model.tools, i, tool.translation, tool.J)
