"""The terms of Cartesian impedance control: task inertia, damping design, nullspaces, torque bounds.

Vectors of the task (6,) have a linear part, then an angular part, in world axes at the tool's origin. J (6, n) is the
Jacobian of an arm's tool with n joints, and M (n, n) is the inertia of these joints. Units: stiffness [N/m, Nm/rad],
damping [Ns/m, Nms/rad], task inertia [kg, kg m^2].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.control.geometry.closest_points import dot, size_of
from q2r2_control.control.geometry.kinematics import Chain, Placements, place
from q2r2_control.control.jit import kernel, numpy_kernel
from q2r2_control.control.kernel_pointers import KernelPointer, pointee
from q2r2_control.control.tasks.frame import Tools, rotation_vector, times_transposed, tool_jacobian, tool_pose
from q2r2_control.types import Array

BoolArray = npt.NDArray[np.bool_]

# No number from a real robot or controller is as large as this. The squares of smaller numbers are finite.
ABSURD = 1e9
# The greatest inertia that a tool may have in any direction [kg]. In a working posture it is below a fifth of this.
_HEAVIEST = 1000.0


class PositionLimits(NamedTuple):
    """Position limits, and the spring that begins before each limit."""

    lower: Array  # (nv,) [rad]
    upper: Array  # (nv,) [rad]
    stiffness: float  # [Nm/rad]
    damping: float  # [Nms/rad]
    distance: float  # Distance from the limit at which the spring begins [rad].


@numpy_kernel
def plausible(numbers: Array) -> bool:
    """Return whether all numbers are finite and their absolute values are below ``ABSURD``."""
    return bool((np.abs(numbers) < ABSURD).all())


@numpy_kernel
def clip_errors(errors: Array, position: float, rotation: float) -> BoolArray:
    """Shorten ``errors`` (k, 6) to at most ``position`` [m] and ``rotation`` [rad].

    The result (k,) is True for each error that was longer than one of these bounds.
    """
    clipped = np.zeros(len(errors), dtype=np.bool_)
    for i in range(len(errors)):
        nearer = position / max(size_of(errors[i, :3]), position)
        less = rotation / max(size_of(errors[i, 3:]), rotation)
        for k in range(3):
            errors[i, k] *= nearer
            errors[i, 3 + k] *= less
        clipped[i] = min(nearer, less) < 1.0
    return clipped


@numpy_kernel
def inertia_and_damping(mobility: Array, stiffness: Array) -> tuple[Array, Array]:
    """Return the inertia Lambda (6, 6) at the tool, and the damping (6, 6) with the ratio 1 for a ``stiffness`` (6,).

    ``mobility`` is J M^-1 J' (6, 6), whose inverse is Lambda (Khatib 1987, eq. 18). The damping gives every mode of
    Lambda x'' + D x' + K x = 0 the same ratio, by double diagonalisation (Albu-Schaeffer, Ott, Frese, Hirzinger:
    "Cartesian impedance control of redundant robots: recent results with the DLR-light-weight-arms", ICRA 2003):
    K v = lambda Lambda v, V' Lambda V = I, Q = V^-1, D = 2 Q' diag(xi sqrt(lambda)) Q. Because K is diagonal,
    K^1/2 J M^-1 J' K^1/2 = U diag(lambda) U' gives Q' = K^1/2 U diag(lambda)^-1/2, and with it Lambda = Q' Q.

    A lambda is the square of a mode's frequency. Near a singular posture, some lambda vanishes, and Lambda and the
    damping force would grow without bound. Each lambda is therefore raised to at least the value that belongs to a mass
    of 1000 kg. Modes with a larger lambda stay exact. A damping term on the diagonal would instead make the projector
    with Lambda inexact in every posture.
    """
    root = np.sqrt(stiffness)
    scaled = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            scaled[i, j] = root[i] * mobility[i, j] * root[j]
    values, vectors = np.linalg.eigh(scaled)
    inertia, damping = np.zeros((6, 6)), np.zeros((6, 6))
    for k in range(6):
        value = max(values[k], stiffness[0] / _HEAVIEST)
        for i in range(6):
            for j in range(6):
                mode = root[i] * vectors[i, k] * vectors[j, k] * root[j]
                inertia[i, j] += mode / value
                damping[i, j] += 2.0 * mode / np.sqrt(value)
    return inertia, damping


@numpy_kernel
def consistent_force(inertia: Array, J: Array, M_inverse: Array, torque: Array) -> Array:
    """Return the force F (6,) with which the joint torque ``torque`` - J' F does not accelerate the tool.

    This difference is N ``torque`` with N = I - J' Lambda J M^-1 (Khatib 1987, eq. 51).
    """
    return inertia @ (J @ (M_inverse @ torque))


class ImpedanceModel(NamedTuple):
    """Data that do not change between ticks."""

    chain: Chain
    tools: Tools  # The tools of all k arms.
    limits: PositionLimits
    torque_limit: Array  # (nv,) [Nm]
    largest_error: Array  # (2,) [m, rad]


class ImpedanceData(NamedTuple):
    """The measurement of one tick, and the arrays that are written in this tick."""

    inputs: Array  # (6, nv) Measured q and v; q, v and a of the newest reference; torque that is added [Nm].
    due: Array  # (2, nv) q and v of the reference that is due now.
    springs: Array  # (k, 5) The values of ``LIVE_IMPEDANCE`` for each arm.
    M: Array  # (nv, nv) Joint-space inertia matrix.
    torque: Array  # (nv,) Input: torque of gravity and Coriolis forces. Output: torque of the control law [Nm].
    commanded: Array  # (nv,) The last torque, within all bounds [Nm].
    saturated: BoolArray  # (nv,) Joints for which the control law asks for more torque than their limit.
    late: BoolArray  # (nv,) Joints whose torque would have to change faster than its rate limit allows.
    J: Array  # (k, 6, nv) Jacobians at the measured posture.
    error: Array  # (k, 6) Clipped displacement from the measured to the wanted tool pose [m], [rad].
    clipped: BoolArray  # (k,) True if the displacement of the arm was too long, and was clipped.
    repulsion: Array  # (nv,) Torque from position limits [Nm].
    wanted_twist: Array  # (k, 6) Twists of the tools at the reference that is due now [m/s], [rad/s].
    wanted_rotation: Array  # (k, 3, 3) Wanted rotations of the tools.
    wanted_translation: Array  # (k, 3) [m]
    rotation: Array  # (3, 3) Buffer for the measured rotation of one tool.
    translation: Array  # (3,) Buffer for the measured position of one tool [m].
    turn: Array  # (3, 3) Buffer for the rotation from the measured to the wanted orientation.
    placements: Placements  # Buffer for the poses of the joint frames.

    @classmethod
    def empty(cls, model: ImpedanceModel, springs: Array) -> ImpedanceData:
        """Return arrays of the sizes that ``model`` needs."""
        k, nv = model.tools.member.shape
        return cls(
            inputs=np.zeros((6, nv)),
            due=np.zeros((2, nv)),
            springs=springs,
            M=np.eye(nv),
            torque=np.zeros(nv),
            commanded=np.zeros(nv),
            saturated=np.zeros(nv, dtype=np.bool_),
            late=np.zeros(nv, dtype=np.bool_),
            J=np.zeros((k, 6, nv)),
            error=np.zeros((k, 6)),
            clipped=np.zeros(k, dtype=np.bool_),
            repulsion=np.zeros(nv),
            wanted_twist=np.zeros((k, 6)),
            wanted_rotation=np.zeros((k, 3, 3)),
            wanted_translation=np.zeros((k, 3)),
            rotation=np.zeros((3, 3)),
            translation=np.zeros(3),
            turn=np.zeros((3, 3)),
            placements=Placements.empty(model.chain),
        )


@numpy_kernel
def impedance_torque(
    model_pointer: KernelPointer, data_pointer: KernelPointer, change: float
) -> tuple[bool, bool, bool, bool]:
    """Write the torque of one tick into ``data.commanded``, at most ``change`` [Nm] from the last torque.

    If the reference is not finite, the arms are held at the last reference. One kernel does all of this, because every
    call from Python takes time.

    Returns:
        Whether there is a torque, whether an error was clipped, whether a position limit repels a joint, and whether a
        torque bound was active. There is no torque if the measured state, or a torque computed from it, is not finite.
    """
    model, data = pointee(model_pointer), pointee(data_pointer)
    measured, reference, added = data.inputs[:2], data.inputs[2:5], data.inputs[5]
    known = plausible(reference)
    usable = plausible(measured) and plausible(added)
    if usable:
        if known:
            np.add(data.torque, data.M @ reference[2], data.torque)
        _add_springs(model, data, measured[0], measured[1])
        np.add(data.torque, data.repulsion + added, data.torque)
        usable = np.isfinite(data.torque).all()
    if known:
        copy(reference[0], data.due[0])
        copy(reference[1], data.due[1])
    else:
        data.due[1] = 0.0
    if not usable:
        return False, False, False, False
    commanded, saturated, late = bound_torque(data.torque, data.commanded, model.torque_limit, change)
    copy(commanded, data.commanded)
    copy(saturated, data.saturated)
    copy(late, data.late)
    return True, data.clipped.any(), data.repulsion.any(), saturated.any() or late.any()


@numpy_kernel
def _add_springs(model: ImpedanceModel, data: ImpedanceData, q: Array, v: Array) -> None:
    """Add the impedance torques of all arms to ``data.torque``. Write the torque of the limits to ``data.repulsion``.

    The torque of an arm is J' (K e + D e') + N t_p. The first part is the Cartesian impedance. The second part is the
    null-space impedance: the torque t_p of the posture, projected by N into the nullspace of the tool's motion.
    """
    _update_tools(model, data, q)
    copy(clip_errors(data.error, model.largest_error[0], model.largest_error[1]), data.clipped)
    M_inverse, stiffness, posture = np.linalg.inv(data.M), np.zeros(6), np.zeros(len(q))
    for i in range(len(data.springs)):
        J, values, member = data.J[i], data.springs[i], model.tools.member[i]
        for k in range(6):
            stiffness[k] = values[k // 3]
        inertia, damping = inertia_and_damping(J @ M_inverse @ J.T, stiffness)
        force = stiffness * data.error[i] + values[2] * (damping @ (data.wanted_twist[i] - J @ v))
        for j in range(len(q)):
            # The damping of each joint has the set damping ratio for the inertia that this joint moves alone.
            joint_damping = 2.0 * values[4] * np.sqrt(values[3] * data.M[j, j])
            posture[j] = (values[3] * (data.due[0, j] - q[j]) + joint_damping * (data.due[1, j] - v[j])) * member[j]
        force -= consistent_force(inertia, J, M_inverse, posture)
        np.add(data.torque, posture + J.T @ force, data.torque)
    copy(limit_repulsion(model.limits, q, v, data.due[0]), data.repulsion)


@kernel
def _update_tools(model: ImpedanceModel, data: ImpedanceData, q: Array) -> None:
    """Write the Jacobians at ``q``, the wanted twists, and the displacements from measured to wanted tool poses."""
    place(model.chain, data.due[0], data.placements)
    for i in range(len(data.J)):
        tool_pose(data.placements, model.tools, i, data.wanted_rotation[i], data.wanted_translation[i])
        tool_jacobian(model.chain, data.placements, model.tools, i, data.wanted_translation[i], data.J[i])
        for k in range(6):
            data.wanted_twist[i, k] = dot(data.J[i, k], data.due[1])
    place(model.chain, q, data.placements)
    for i in range(len(data.J)):
        tool_pose(data.placements, model.tools, i, data.rotation, data.translation)
        tool_jacobian(model.chain, data.placements, model.tools, i, data.translation, data.J[i])
        for k in range(3):
            data.error[i, k] = data.wanted_translation[i, k] - data.translation[k]
        times_transposed(data.wanted_rotation[i], data.rotation, data.turn)
        rotation_vector(data.turn, data.error[i, 3:])


@kernel
def copy(values: Array, out: Array) -> None:
    """Write ``values`` (n,) into ``out`` (n,). Numba takes seconds to compile ``out[:] = values``."""
    for i in range(values.shape[0]):
        out[i] = values[i]


@numpy_kernel
def limit_repulsion(limits: PositionLimits, q: Array, v: Array, wanted: Array) -> Array:
    """Return the torque (nv,) [Nm] with which a spring before each position limit pushes its joint back.

    The spring begins at ``limits.distance`` before the limit. If the reference ``wanted`` (nv,) is nearer to the limit,
    the spring begins at the reference: the reference keeps the limits by itself, and a spring that keeps a joint from
    its reference would keep the tool from its target. The damping grows from 0 over the same distance, so that the
    torque does not jump. The damping may reduce the torque to 0, but it never pulls a joint towards its limit.
    """
    reach, share = limits.distance, limits.damping / limits.distance
    below = np.maximum(np.minimum(limits.lower + reach, wanted) - q, 0.0)
    above = np.maximum(q - np.maximum(limits.upper - reach, wanted), 0.0)
    up = np.maximum(limits.stiffness * below - share * np.minimum(below, reach) * v, 0.0)
    down = np.maximum(limits.stiffness * above + share * np.minimum(above, reach) * v, 0.0)
    return up - down


@numpy_kernel
def bound_torque(tau: Array, last: Array, limit: Array, change: float) -> tuple[Array, BoolArray, BoolArray]:
    """Return ``tau`` (nv,) within +-``limit`` (nv,) and at most ``change`` from ``last`` (nv,), all in Nm.

    If ``last`` is within the limit, both bounds hold: the result lies between ``last`` and the saturated torque, and is
    therefore within the limit as well. The other two results (nv,) tell which joints were saturated, and which torques
    would have to change by more than ``change``.
    """
    within = np.minimum(np.maximum(tau, -limit), limit)
    bounded = np.minimum(np.maximum(within, last - change), last + change)
    return bounded, within != tau, bounded != within
