"""The law of the impedance, compiled: see :class:`ImpedanceController`; its pieces stand in impedance_terms.py.

One call makes a tick's torques of all arms out of what was measured and wanted: a dozen NumPy calls on matrices of
seven rows cost more than the work they do, and Pinocchio's on the way in and out.
"""

from __future__ import annotations

from q2r2_control.compliance.impedance_data import ArmScratch, ImpedanceData, ImpedanceModel, ToolState
from q2r2_control.compliance.impedance_terms import (
    bound_torque,
    clip_error,
    damp,
    limit_repulsion,
    take_consistent,
    take_kinematic,
    task_inertia,
)
from q2r2_control.compliance.joint_dynamics import inverse_dynamics
from q2r2_control.compliance.small_matrices import finite, solve_factor, times
from q2r2_control.control.cholesky import factorise
from q2r2_control.control.geometry.kinematics import IntArray, place
from q2r2_control.control.jit import Held, borrowed, inlined_kernel, kernel
from q2r2_control.control.tasks.frame import rotation_vector, tool_jacobian, tool_pose
from q2r2_control.types import Array

# What there is to report of a tick, as bits.
HELD, BOUNDED, CLIPPED, REPELLED = 1, 2, 4, 8


@kernel
def impedance_torque(held_model: Held, held_data: Held, change: float) -> int:
    """Of ``inputs`` the torques ``bounded``, no further than ``change`` [Nm] from the last; what there is to report.

    Where the state, or what comes of it, is not finite, they are gravity's at the last usable posture.
    """
    model, data = borrowed(held_model), borrowed(held_data)
    _exchange(data)
    if not (finite(data.inputs[0:2]) and _law(model, data) and finite(data.tau.reshape(1, -1))):
        _gravity(model, data)
        return HELD | _bound(model, data, change)
    for j in range(data.usable_q.shape[0]):
        data.usable_q[j] = data.inputs[0, j]
    found = CLIPPED if data.clipped.any() else 0
    if data.repulsion.any():
        found |= REPELLED
    return found | _bound(model, data, change)


@kernel
def gravity_torque(held_model: Held, held_data: Held) -> None:
    """What bears the arms at rest at ``usable_q`` into ``tau``."""
    _gravity(borrowed(held_model), borrowed(held_data))


@inlined_kernel
def _exchange(data: ImpedanceData) -> None:
    """Take the newest reference in for the next tick; one that is not finite is not used, and the last one is held."""
    references = data.references
    usable = finite(data.inputs[2:5])
    for j in range(data.inputs.shape[1]):
        references.wanted_q[j], references.wanted_v[j] = references.due_q[j], references.due_v[j]
        references.due_v[j], references.a[j] = 0.0, 0.0
        if usable:
            references.due_q[j], references.due_v[j] = data.inputs[2, j], data.inputs[3, j]
            references.a[j] = data.inputs[4, j]


@kernel
def _law(model: ImpedanceModel, data: ImpedanceData) -> bool:
    """The torque of all arms, without bounds, into ``tau``; False where the numbers are too large for that."""
    q, v, references, dynamics = data.inputs[0], data.inputs[1], data.references, data.dynamics
    place(model.chain, q, data.measured.placements)
    place(model.chain, references.wanted_q, data.wanted.placements)
    inverse_dynamics(model.chain, model.bodies, data.measured.placements, v, references.a, dynamics)
    for i in range(q.shape[0]):
        for j in range(i, q.shape[0]):
            data.factor[i, j] = dynamics.M[i, j]
    if not factorise(data.factor):
        return False
    limit_repulsion(model.limits, q, v, references.wanted_q, data.repulsion)
    for j in range(q.shape[0]):
        data.tau[j] = dynamics.tau[j] + data.repulsion[j] + data.inputs[5, j]
    for i in range(model.dofs.shape[0]):
        _add_arm(model, data, i, model.joints[i, : model.dofs[i]])
    return True


@kernel
def _gravity(model: ImpedanceModel, data: ImpedanceData) -> None:
    place(model.chain, data.usable_q, data.measured.placements)
    still = data.no_motion
    inverse_dynamics(model.chain, model.bodies, data.measured.placements, still, still, data.dynamics)
    for j in range(data.tau.shape[0]):
        data.tau[j] = data.dynamics.tau[j]


@inlined_kernel
def _bound(model: ImpedanceModel, data: ImpedanceData, change: float) -> int:
    """Bring ``tau`` within its limits and ``change`` [Nm] of the last command."""
    held_back = bound_torque(data.tau, data.bounded, model.torque_limit, change, data.saturated, data.rate_limited)
    return BOUNDED if held_back else 0


@inlined_kernel
def _add_arm(model: ImpedanceModel, data: ImpedanceData, i: int, joints: IntArray) -> None:
    """Add the torque of one arm's spring and posture to ``tau``; writes its clipped error."""
    _tool_error(model, data, i)
    data.clipped[i] = clip_error(data.errors[i], model.max_position_error, model.max_rotation_error)
    n = joints.shape[0]
    arm, terms, springs = data.arm, data.arm.terms, data.springs[i]
    J, M, speed, torque = arm.J[: 6 * n].reshape(6, n), arm.M[: n * n].reshape(n, n), arm.speed[:n], arm.torque[:n]
    _gather(data, joints, J, M)
    for k in range(n):
        arm.springs[k] = springs[3]
    damp(arm.springs[:n], M, springs[4], speed, terms)
    for k in range(n):
        j = joints[k]
        torque[k] = springs[3] * (data.references.wanted_q[j] - data.inputs[0, j]) + speed[k]
    _move_tool(data.factor, joints, J, arm)
    task_inertia(arm.mobility, terms, arm.inertia)
    for k in range(6):
        arm.stiffness[k] = springs[0] if k < 3 else springs[1]
    damp(arm.stiffness, arm.inertia, springs[2], arm.error_rate, terms)
    if model.consistent:
        take_consistent(J, arm.inertia, arm.acceleration, torque, terms)
    else:
        take_kinematic(J, torque, terms)
    for k in range(n):
        total = torque[k]
        for row in range(6):
            total += J[row, k] * (arm.stiffness[row] * data.errors[i, row] + arm.error_rate[row])
        data.tau[joints[k]] += total


@inlined_kernel
def _gather(data: ImpedanceData, joints: IntArray, J: Array, M: Array) -> None:
    """Of one arm's joints Jacobian and inertia, and how fast tool and joints are to be faster than they are."""
    arm, references, v = data.arm, data.references, data.inputs[1]
    for row in range(6):
        arm.error_rate[row] = 0.0
    for k in range(joints.shape[0]):
        j = joints[k]
        arm.speed[k] = references.wanted_v[j] - v[j]
        for row in range(6):
            J[row, k] = data.measured.J[row, j]
            arm.error_rate[row] += data.wanted.J[row, j] * references.wanted_v[j] - J[row, k] * v[j]
        for m in range(joints.shape[0]):
            M[k, m] = data.dynamics.M[j, joints[m]]


@inlined_kernel
def _move_tool(factor: Array, joints: IntArray, J: Array, arm: ArmScratch) -> None:
    """How forces and the posture's torque move the tool, of the ``factor`` L of M: by W = L^-1 (J', torque)."""
    W = arm.W
    for j in range(W.shape[0]):
        for row in range(7):
            W[j, row] = 0.0
    for k in range(joints.shape[0]):
        for row in range(6):
            W[joints[k], row] = J[row, k]
        W[joints[k], 6] = arm.torque[k]
    solve_factor(factor, W)
    for row in range(6):
        arm.acceleration[row] = 0.0
        for column in range(6):
            arm.mobility[row, column] = 0.0
    for j in range(W.shape[0]):
        for row in range(6):
            arm.acceleration[row] += W[j, row] * W[j, 6]
            for column in range(6):
                arm.mobility[row, column] += W[j, row] * W[j, column]


@inlined_kernel
def _tool_error(model: ImpedanceModel, data: ImpedanceData, i: int) -> None:
    """Way from the measured to the wanted pose of tool ``i`` into ``errors``; writes both Jacobians."""
    measured, wanted, error, turn = data.measured, data.wanted, data.errors[i], data.arm.turn
    _update_tool(model, i, measured)
    _update_tool(model, i, wanted)
    for row in range(3):
        error[row] = wanted.translation[row] - measured.translation[row]
        times(measured.rotation, wanted.rotation[row], turn[row])
    rotation_vector(turn, error[3:])


@inlined_kernel
def _update_tool(model: ImpedanceModel, i: int, tool: ToolState) -> None:
    """Pose and Jacobian of tool ``i`` where the joint frames are placed."""
    tool_pose(tool.placements, model.tools, i, tool.rotation, tool.translation)
    tool_jacobian(model.chain, tool.placements, model.tools, i, tool.translation, tool.J)
