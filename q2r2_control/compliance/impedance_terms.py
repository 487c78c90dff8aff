"""Pure pieces of Cartesian impedance control: task inertia, damping design, nullspaces, torque bounds, compiled.

Task vectors (6,) are linear, then angular, in world axes at the tool's origin; J (6, n) is that Jacobian of an arm's n
joints. Stiffness [N/m, Nm/rad], damping [Ns/m, Nms/rad], task inertia [kg, kg m^2].

impedance_kernels.py puts them together. Matrices that are not finite raise :class:`numpy.linalg.LinAlgError`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.compliance.small_matrices import factorise, invert, product, square_root
from q2r2_control.control.jit import kernel
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array

BoolArray = npt.NDArray[np.bool_]

# Makes radians comparable to metres, as in the QP's tool task.
_METRES = np.array([1.0, 1.0, 1.0, ROTATION_LENGTH, ROTATION_LENGTH, ROTATION_LENGTH])
_SCALE = np.outer(_METRES, _METRES)
_ROWS = _METRES.reshape(6, 1)
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


@kernel
def clip_error(error: Array, position: float, rotation: float) -> tuple[Array, bool]:
    """``error`` (6,) with each part no longer than ``position`` [m], ``rotation`` [rad]; and whether it was longer."""
    nearer = position / max(np.sqrt(np.sum(error[:3] ** 2)), position)
    less = rotation / max(np.sqrt(np.sum(error[3:] ** 2)), rotation)
    clipped = error.copy()
    clipped[:3] *= nearer
    clipped[3:] *= less
    return clipped, min(nearer, less) < 1.0


@kernel
def task_inertia(J: Array, M_inverse: Array) -> Array:
    """Inertia Lambda = (J M^-1 J')^-1 (6, 6) that a hand at the tool feels (Khatib 1987, eq. 18).

    Near a singular posture the mobility J M^-1 J' vanishes along some direction and Lambda, and with it the damping
    force, would grow without bound. There the mobility's eigenvalues, after a radian was made comparable to a metre,
    are raised to that of 1000 kg. All others stay exact, other than with a damping term on the diagonal, which would
    make the projector that is built with Lambda leak everywhere.
    """
    return _floored_inverse(product(product(J, M_inverse), J.T), 1.0 / _HEAVIEST)


@kernel
def _floored_inverse(A: Array, least: float) -> Array:
    """Inverse of a symmetric positive semidefinite A (6, 6) whose scaled eigenvalues are raised to ``least``.

    Away from singular postures none has to be raised: A - least is positive definite, and no eigenvalue is needed.
    """
    factor, inverse = A * _SCALE, np.empty_like(A)
    for i in range(A.shape[0]):
        factor[i, i] -= least
    if factorise(factor) and invert(A, factor, inverse):
        return inverse
    values, vectors = np.linalg.eigh(A * _SCALE)
    vectors *= _ROWS
    return (vectors / np.maximum(values, least)) @ vectors.T


@kernel
def double_diagonalised_damping(stiffness: Array, inertia: Array, damping_ratio: float) -> Array:
    """Damping D (n, n) that gives every mode of  inertia x'' + D x' + diag(stiffness) x = 0  the damping ratio xi.

    ``stiffness`` (n,) along the axes, positive; ``inertia`` (n, n) symmetric positive definite. Albu-Schaeffer, Ott,
    Frese, Hirzinger: "Cartesian impedance control of redundant robots: recent results with the
    DLR-light-weight-arms", ICRA 2003: K v = lambda Lambda v with V' Lambda V = I, Q = V^-1,
    D = 2 Q' diag(xi sqrt(lambda)) Q. K being diagonal, W and U of  K^-1/2 Lambda K^-1/2 = U W U'  give
    lambda = 1 / W, Q = W^1/2 U' K^1/2, and D = 2 xi K^1/2 U W^1/2 U' K^1/2: between the K^1/2 stands the square root of
    K^-1/2 Lambda K^-1/2.
    """
    root = np.sqrt(stiffness)
    both = np.outer(root, root)
    scaled = inertia / both
    X, found = square_root(scaled)
    if found:
        return 2.0 * damping_ratio * both * X
    # Of an inertia that is positive definite but for rounding.
    W, U = np.linalg.eigh(scaled)
    U *= root.reshape((-1, 1))
    return (U * (2.0 * damping_ratio * np.sqrt(np.maximum(W, 0.0)))) @ U.T


@kernel
def consistent_projector(J: Array, M_inverse: Array, inertia: Array) -> Array:
    """N (n, n): torque N tau accelerates no tool, J M^-1 N = 0: I - J' Lambda J M^-1 (Khatib 1987, eq. 51)."""
    return np.eye(J.shape[1]) - product(product(product(J.T, inertia), J), M_inverse)


@kernel
def kinematic_projector(J: Array) -> Array:
    """N (n, n): torque N tau balances no static force at the tool, J N = 0: I - J' J'^+; needs no inertia."""
    return np.eye(J.shape[1]) - product(product(J.T, _floored_inverse(product(J, J.T), _LEAST_MOTION**2)), J)


@kernel
def limit_repulsion(limits: PositionLimits, q: Array, v: Array, wanted: Array) -> Array:
    """Torque (n,) [Nm] away from position limits, of a spring that begins some way before each.

    Where ``wanted`` (n,), the reference, lies nearer to the limit, the spring begins there: the reference keeps the
    limits by itself, and what holds a joint off its reference would hold the tool off its target. The damping
    grows from 0 over that way, so that the torque does not jump, and it only brakes, it never pulls.
    """
    reach = limits.distance
    below = np.maximum(np.minimum(limits.lower + reach, wanted) - q, 0.0)
    above = np.maximum(q - np.maximum(limits.upper - reach, wanted), 0.0)
    share = limits.damping / reach
    towards_upper = np.maximum(limits.stiffness * below - share * np.minimum(below, reach) * v, 0.0)
    towards_lower = np.maximum(limits.stiffness * above + share * np.minimum(above, reach) * v, 0.0)
    return towards_upper - towards_lower


class BoundedTorque(NamedTuple):
    """A torque within its bounds, and which bounds held it back."""

    tau: Array  # (n,) [Nm]
    saturated: BoolArray  # (n,)
    rate_limited: BoolArray  # (n,)


@kernel
def bound_torque(tau: Array, last: Array, limit: Array, change: float) -> BoundedTorque:
    """``tau`` (n,) within +-``limit`` (n,) and no further than ``change`` from ``last`` (n,), all [Nm].

    First the torque is saturated, then it approaches what remains by at most ``change``. Both bounds hold afterwards
    whenever ``last`` is within the limit: the result lies between ``last`` and the saturated torque, hence within the
    limit too.
    """
    saturated = np.minimum(np.maximum(tau, -limit), limit)
    bounded = np.minimum(np.maximum(saturated, last - change), last + change)
    return BoundedTorque(bounded, saturated != tau, bounded != saturated)
