"""Pieces of Cartesian impedance control: task inertia, damping design, nullspaces, torque bounds, compiled.

Task vectors (6,) are linear, then angular, in world axes at the tool's origin; J (6, n) is that Jacobian of an arm's n
joints. Stiffness [N/m, Nm/rad], damping [Ns/m, Nms/rad], task inertia [kg, kg m^2].

impedance_kernels.py puts them together. Of damping and projectors only what they make of a vector is computed, in its
place, and nothing is allocated: an array costs as much as what is in it. Nothing raises: what comes of numbers that are
not finite, or too large, is not finite.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.compliance.small_matrices import (
    Scratch,
    diagonalise,
    factorise,
    invert,
    root_times,
    times,
)
from q2r2_control.control.jit import kernel
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array

BoolArray = npt.NDArray[np.bool_]

# Makes radians comparable to metres, as in the QP's tool task.
_METRES = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])
# No direction of a tool counts for more than this [kg], a rotation for this times 0.3^2 [kg m^2]. An arm whose
# rotors weigh most of it stays below a fifth of it in every posture that it works in.
_HEAVIEST = 1000.0
# A direction in which the scaled Jacobian is smaller is taken for one in which the arm cannot move its tool.
_LEAST_MOTION = 0.05  # [m/rad]


class PositionLimits(NamedTuple):
    """Position limits with the spring that begins before each."""

    lower: Array  # (n,) [rad]
    upper: Array  # (n,)
    stiffness: float  # [Nm/rad]
    damping: float  # [Nms/rad]
    distance: float  # where the spring begins [rad]


class TermScratch(NamedTuple):
    """For an arm of up to m joints."""

    matrices: Scratch
    root: Array  # (n,), n being the greater of m and 6
    rate: Array  # (n,)
    force: Array  # (6,)
    motion: Array  # (6,)
    square: Array  # (6, 6)
    inverse: Array  # (6, 6)

    @classmethod
    def empty(cls, joints: int) -> TermScratch:
        n = max(joints, 6)
        sixes = np.zeros(6), np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6))
        return cls(Scratch.empty(n), np.zeros(n), np.zeros(n), *sixes)


@kernel
def clip_error(error: Array, position: float, rotation: float) -> bool:
    """Make each part of ``error`` (6,) no longer than ``position`` [m], ``rotation`` [rad]; whether it was longer."""
    nearer = position / max(_length(error[:3]), position)
    less = rotation / max(_length(error[3:]), rotation)
    for k in range(3):
        error[k] *= nearer
        error[3 + k] *= less
    return min(nearer, less) < 1.0


@kernel
def _length(vector: Array) -> float:
    return np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@kernel
def task_inertia(mobility: Array, scratch: TermScratch, out: Array) -> None:
    """Inertia Lambda (6, 6) that a hand at the tool feels, of its ``mobility`` J M^-1 J' (Khatib 1987, eq. 18).

    Near a singular posture the mobility vanishes along some direction and Lambda, and with it the damping force, would
    grow without bound. There the mobility's eigenvalues, after a radian was made comparable to a metre, are raised to
    that of 1000 kg. All others stay exact, other than with a damping term on the diagonal, which would make the
    projector that is built with Lambda leak everywhere.
    """
    _invert_floored(mobility, 1.0 / _HEAVIEST, scratch, out)


@kernel
def _invert_floored(A: Array, least: float, scratch: TermScratch, out: Array) -> None:
    """Inverse of a symmetric positive semidefinite A (6, 6) whose scaled eigenvalues are raised to ``least``.

    Away from singular postures none has to be raised: A - least is positive definite, and no eigenvalue is needed.
    """
    factor, vectors = scratch.matrices.factor[:36].reshape(6, 6), scratch.matrices.inverse[:36].reshape(6, 6)
    for i in range(6):
        for j in range(6):
            factor[i, j] = A[i, j] * (_METRES[i] * _METRES[j])
        factor[i, i] -= least
    if factorise(factor) and invert(A, factor, out):
        return
    for i in range(6):
        for j in range(6):
            factor[i, j] = A[i, j] * (_METRES[i] * _METRES[j])
    diagonalise(factor, vectors)
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
            for k in range(6):
                out[i, j] += vectors[i, k] * vectors[j, k] / max(factor[k, k], least)
            out[i, j] *= _METRES[i] * _METRES[j]


@kernel
def damp(stiffness: Array, inertia: Array, damping_ratio: float, rate: Array, scratch: TermScratch) -> None:
    """Make ``rate`` (n,) x' D x', D giving every mode of  inertia x'' + D x' + diag(stiffness) x = 0  the ratio xi.

    ``stiffness`` (n,) along the axes, positive; ``inertia`` (n, n) symmetric positive definite. Albu-Schaeffer, Ott,
    Frese, Hirzinger: "Cartesian impedance control of redundant robots: recent results with the
    DLR-light-weight-arms", ICRA 2003: K v = lambda Lambda v with V' Lambda V = I, Q = V^-1,
    D = 2 Q' diag(xi sqrt(lambda)) Q. K being diagonal, W and U of  K^-1/2 Lambda K^-1/2 = U W U'  give
    lambda = 1 / W, Q = W^1/2 U' K^1/2, and D = 2 xi K^1/2 U W^1/2 U' K^1/2: between the K^1/2 stands the square root of
    K^-1/2 Lambda K^-1/2.
    """
    n, root, matrices = len(stiffness), scratch.root, scratch.matrices
    scaled = matrices.matrix[: n * n].reshape(n, n)
    for i in range(n):
        root[i] = np.sqrt(stiffness[i])
        rate[i] *= root[i]
        scratch.rate[i] = rate[i]
    _scale(inertia, root, scaled)
    if not root_times(scaled, rate, matrices):
        _scale(inertia, root, scaled)
        _root_times_nearly(scaled, scratch.rate, matrices.inverse[: n * n].reshape(n, n), rate)
    for i in range(n):
        rate[i] *= 2.0 * damping_ratio * root[i]


@kernel
def _scale(inertia: Array, root: Array, out: Array) -> None:
    for i in range(inertia.shape[0]):
        for j in range(inertia.shape[0]):
            out[i, j] = inertia[i, j] / (root[i] * root[j])


@kernel
def _root_times_nearly(A: Array, x: Array, vectors: Array, out: Array) -> None:
    """As :func:`root_times`, of an A that is positive definite but for rounding."""
    n = A.shape[0]
    diagonalise(A, vectors)
    for i in range(n):
        out[i] = 0.0
    for k in range(n):
        share = 0.0
        for i in range(n):
            share += vectors[i, k] * x[i]
        share *= np.sqrt(max(A[k, k], 0.0))
        for i in range(n):
            out[i] += share * vectors[i, k]


@kernel
def take_consistent(J: Array, inertia: Array, acceleration: Array, torque: Array, scratch: TermScratch) -> None:
    """Make ``torque`` (n,) tau N tau, which accelerates no tool; ``acceleration`` (6,) is that of tau, J M^-1 tau.

    N = I - J' Lambda J M^-1 (Khatib 1987, eq. 51).
    """
    times(inertia, acceleration, scratch.force)
    _take(J, scratch.force, torque)


@kernel
def take_kinematic(J: Array, torque: Array, scratch: TermScratch) -> None:
    """Make ``torque`` (n,) tau N tau, which balances no static force at the tool, J N = 0; needs no inertia.

    N = I - J' J'^+.
    """
    for i in range(6):
        times(J, J[i], scratch.motion)
        for j in range(6):
            scratch.square[i, j] = scratch.motion[j]
    times(J, torque, scratch.motion)
    _invert_floored(scratch.square, _LEAST_MOTION**2, scratch, scratch.inverse)
    times(scratch.inverse, scratch.motion, scratch.force)
    _take(J, scratch.force, torque)


@kernel
def _take(J: Array, force: Array, torque: Array) -> None:
    """Take J' force away from ``torque``."""
    for k in range(J.shape[1]):
        for i in range(6):
            torque[k] -= J[i, k] * force[i]


@kernel
def limit_repulsion(limits: PositionLimits, q: Array, v: Array, wanted: Array, out: Array) -> bool:
    """Torque (n,) [Nm] away from position limits into ``out``, of a spring that begins some way before each; if any.

    Where ``wanted`` (n,), the reference, lies nearer to the limit, the spring begins there: the reference keeps the
    limits by itself, and what holds a joint off its reference would hold the tool off its target. The damping
    grows from 0 over that way, so that the torque does not jump, and it only brakes, it never pulls.
    """
    reach, share, pushes = limits.distance, limits.damping / limits.distance, False
    for i in range(len(q)):
        below = max(min(limits.lower[i] + reach, wanted[i]) - q[i], 0.0)
        above = max(q[i] - max(limits.upper[i] - reach, wanted[i]), 0.0)
        towards_upper = max(limits.stiffness * below - share * min(below, reach) * v[i], 0.0)
        towards_lower = max(limits.stiffness * above + share * min(above, reach) * v[i], 0.0)
        out[i] = towards_upper - towards_lower
        pushes |= out[i] != 0.0
    return pushes


@kernel
def bound_torque(tau: Array, last: Array, limit: Array, change: float, saturated: BoolArray, late: BoolArray) -> bool:
    """Make ``last`` (n,) ``tau`` (n,) within +-``limit`` (n,) and no further than ``change`` from it, all [Nm].

    First the torque is saturated, then it approaches what remains by at most ``change``. Both bounds hold afterwards
    whenever ``last`` is within the limit: the result lies between ``last`` and the saturated torque, hence within the
    limit too. ``saturated`` and ``late`` (n,) tell what held it back, the result whether anything did.
    """
    held_back = False
    for i in range(len(tau)):
        within = min(max(tau[i], -limit[i]), limit[i])
        bounded = min(max(within, last[i] - change), last[i] + change)
        saturated[i], late[i] = within != tau[i], bounded != within
        held_back |= saturated[i] or late[i]
        last[i] = bounded
    return held_back
