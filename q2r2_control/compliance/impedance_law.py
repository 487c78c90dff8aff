"""Terms of Cartesian impedance control: task inertia, damping design, nullspaces, torque bounds.

Task vectors (6,) are linear, then angular, in world axes at the tool's origin; J (6, n) is that Jacobian of an arm's n
joints, M (n, n) their inertia. Stiffness [N/m, Nm/rad], damping [Ns/m, Nms/rad], task inertia [kg, kg m^2].
:class:`ImpedanceController` calls them. They are NumPy, compiled, which takes a third of the time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.control.jit import numpy_kernel
from q2r2_control.types import Array

BoolArray = npt.NDArray[np.bool_]

ABSURD = 1e9  # no number that a robot or a controller sends is as large; squares of those below it are finite
# No direction of a tool counts for more than this [kg]. An arm whose rotors weigh most of it stays below a fifth of it
# in every posture that it works in.
_HEAVIEST = 1000.0
# A direction in which the Jacobian is smaller is one in which the arm cannot move its tool [m/rad].
_LEAST_MOTION = 0.05


class PositionLimits(NamedTuple):
    """Position limits with the spring that begins before each."""

    lower: Array  # (nv,) [rad]
    upper: Array  # (nv,)
    stiffness: float  # [Nm/rad]
    damping: float  # [Nms/rad]
    distance: float  # where the spring begins [rad]


@numpy_kernel
def plausible(*arrays: Array) -> bool:
    """Whether all numbers of some vectors are finite and none is absurd."""
    for array in arrays:
        for value in array:
            if not abs(value) < ABSURD:
                return False
    return True


@numpy_kernel
def clip_errors(errors: Array, position: float, rotation: float) -> BoolArray:
    """Make each part of ``errors`` (k, 6) no longer than ``position`` [m], ``rotation`` [rad]; returns which were."""
    clipped = np.zeros(len(errors), dtype=np.bool_)
    for i, error in enumerate(errors):
        nearer = position / max(np.sqrt((error[:3] ** 2).sum()), position)
        less = rotation / max(np.sqrt((error[3:] ** 2).sum()), rotation)
        error[:3] *= nearer
        error[3:] *= less
        clipped[i] = min(nearer, less) < 1.0
    return clipped


@numpy_kernel
def inertia_and_damping(mobility: Array, stiffness: Array) -> tuple[Array, Array]:
    """Inertia Lambda (6, 6) that a hand at the tool feels, and the damping (6, 6) of ratio 1 to its ``stiffness`` (6,).

    ``mobility`` is J M^-1 J' (6, 6), whose inverse is Lambda (Khatib 1987, eq. 18). The damping gives every mode of
    Lambda x'' + D x' + K x = 0 the same ratio, by double diagonalisation (Albu-Schaeffer, Ott, Frese, Hirzinger:
    "Cartesian impedance control of redundant robots: recent results with the DLR-light-weight-arms", ICRA 2003):
    K v = lambda Lambda v, V' Lambda V = I, Q = V^-1, D = 2 Q' diag(xi sqrt(lambda)) Q. K being diagonal,
    K^1/2 J M^-1 J' K^1/2 = U diag(lambda) U' gives Q' = K^1/2 U diag(lambda)^-1/2, and with it Lambda = Q' Q.

    Near a singular posture some lambda vanishes, and Lambda and the damping force would grow without bound. There
    lambda, the square of a mode's frequency, is raised to that of 1000 kg. All others stay exact, other than with a
    damping term on the diagonal, which would make the projector that is built with Lambda leak everywhere.
    """
    root = np.sqrt(stiffness)
    values, vectors = np.linalg.eigh(mobility * np.outer(root, root))
    values = np.maximum(values, stiffness[0] / _HEAVIEST)
    shapes = vectors * root.reshape(-1, 1)
    return (shapes / values) @ shapes.T, (shapes * (2.0 / np.sqrt(values))) @ shapes.T


@numpy_kernel
def consistent_force(inertia: Array, J: Array, M_inverse: Array, torque: Array) -> Array:
    """Force F (6,) that keeps ``torque`` (n,) from accelerating the tool: torque - J' F is N torque.

    N = I - J' Lambda J M^-1 (Khatib 1987, eq. 51).
    """
    return inertia @ (J @ (M_inverse @ torque))


@numpy_kernel
def kinematic_force(J: Array, torque: Array) -> Array:
    """Force F (6,) so that torque - J' F is N torque, which balances no force at the tool; needs no inertia.

    N = I - J' J'^+ with the inverse of J J', whose eigenvalues are raised near a singular posture.
    """
    values, vectors = np.linalg.eigh(J @ J.T)
    return vectors @ ((vectors.T @ (J @ torque)) / np.maximum(values, _LEAST_MOTION**2))


@numpy_kernel
def posture_torque(M: Array, way: Array, speed: Array, stiffness: float, damping_ratio: float) -> Array:
    """Torque (n,) towards a posture that is ``way`` (n,) [rad] off and moves by ``speed`` (n,) [rad/s] faster.

    Each joint's damping has the ratio for the inertia that it moves by itself.
    """
    damping = 2.0 * damping_ratio * np.sqrt(stiffness * np.diag(M))
    return stiffness * way + damping * speed


class ToolMotions(NamedTuple):
    """The tools of k arms, measured and wanted; joints that move no part of an arm have zeros in its J."""

    J: Array  # (k, 6, nv) measured
    error: Array  # (k, 6) way to the wanted pose [m, rad]
    wanted_twist: Array  # (k, 6)
    member: Array  # (k, nv) 1 for joints of the arm


@numpy_kernel
def springs_torque(
    tools: ToolMotions, v: Array, way: Array, speed: Array, M: Array, M_inverse: Array, springs: Array, consistent: bool
) -> Array:
    """Torque (nv,) of all arms' springs and postures: the sum of J' (K e + D e') + N posture.

    ``way`` (nv,) [rad] and ``speed`` (nv,) [rad/s] of the joints are wanted less measured ones, ``springs`` (k, 5) the
    values of ``LIVE_IMPEDANCE``. Raises LinAlgError where numbers are not finite.
    """
    total = np.zeros_like(v)
    for i in range(len(springs)):
        J, values = tools.J[i], springs[i]
        stiffness = np.repeat(values[:2], 3)
        inertia, damping = inertia_and_damping(J @ M_inverse @ J.T, stiffness)
        force = stiffness * tools.error[i] + values[2] * (damping @ (tools.wanted_twist[i] - J @ v))
        posture = tools.member[i] * posture_torque(M, way, speed, values[3], values[4])
        if consistent:
            force -= consistent_force(inertia, J, M_inverse, posture)
        else:
            force -= kinematic_force(J, posture)
        total += posture + J.T @ force
    return total


@numpy_kernel
def limit_repulsion(limits: PositionLimits, q: Array, v: Array, wanted: Array) -> Array:
    """Torque (nv,) [Nm] away from position limits, of a spring that begins some way before each.

    Where ``wanted`` (nv,), the reference, lies nearer to the limit, the spring begins there: the reference keeps the
    limits by itself, and what holds a joint off its reference would hold the tool off its target. The damping grows
    from 0 over that way, so that the torque does not jump, and it only brakes, it never pulls.
    """
    reach, share = limits.distance, limits.damping / limits.distance
    below = np.maximum(np.minimum(limits.lower + reach, wanted) - q, 0.0)
    above = np.maximum(q - np.maximum(limits.upper - reach, wanted), 0.0)
    up = np.maximum(limits.stiffness * below - share * np.minimum(below, reach) * v, 0.0)
    down = np.maximum(limits.stiffness * above + share * np.minimum(above, reach) * v, 0.0)
    return up - down


@numpy_kernel
def bound_torque(tau: Array, last: Array, limit: Array, change: float) -> tuple[Array, BoolArray, BoolArray]:
    """``tau`` (nv,) within +-``limit`` (nv,) and no further than ``change`` from ``last`` (nv,), all [Nm].

    First the torque is saturated, then it approaches what remains by at most ``change``. Both bounds hold afterwards
    whenever ``last`` is within the limit: the result lies between ``last`` and the saturated torque, hence within the
    limit too. The other two (nv,) say which joints were saturated and which could not change fast enough.
    """
    within = np.minimum(np.maximum(tau, -limit), limit)
    bounded = np.minimum(np.maximum(within, last - change), last + change)
    return bounded, within != tau, bounded != within
