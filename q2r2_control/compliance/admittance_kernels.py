"""The law of the admittance, compiled: see :class:`Admittance`.

**The wrench.** The torques that a tool wrench F (force, torque; world axes, at the tool frame's origin) makes in the
joints are tau = J' F, seven numbers for six unknowns. Every left inverse of J' returns a wrench at the tool exactly;
they differ in what they make of noise, of model error and of contacts elsewhere on the arm. The pseudo-inverse
(J')^+ has, of all of these, the least variance where the joints' errors are alike (Gauss and Markov), and needs no
mass matrix, whose masses are not known to better than a factor of two. Forces along which the arm is stretched out
load its bearings and not its joints: directions with a singular value s below a threshold e are damped one by one,
1/s becoming s / (s^2 + e^2 (1 - s^2/e^2)^2) (in the manner of Maciejewski and Klein, J. Robotic Systems 1988), with
metres and radians made comparable by a length. All other directions stay exact. A first-order low-pass smooths the
wrench, and a dead band takes out what is not touch: F (1 - (b / |F|)^2) above the band b, 0 below, which is
continuous and, unlike F - b, soon equal to F, at 7 b to 2 %; in the band's neighbourhood the tool is at most twice as
soft as asked for.

**The motion.**  M x'' + D x' + K x = F,  D = 2 xi sqrt(K M), for the displacement x (3,) in world axes, and alike
for the rotation vector that turns the tool. It is integrated exactly for a wrench that is constant over the tick, by
the closed solution of the oscillator: stable for every dt, with the damping ratio that was asked for at every dt.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.jit import Held, borrowed, kernel
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array

# Of J with rotations times ROTATION_LENGTH: a direction below it counts as singular, since a torque error of 0.1 Nm
# is worth 2 N there [m].
_SINGULAR = 0.05
_SWEEPS = 12
_DIAGONAL = 1e-24  # squares beside the diagonal, of those on it
# What is left of a displacement when it counts as over [m, rad, per second].
_NOTHING = 1e-9

NOT_MEASURED, TOUCHED, UNUSABLE = 0, 1, 2


class AdmittanceModel(NamedTuple):
    """What does not change between ticks; settings linear, then angular."""

    stiffness: Array  # (2,) [N/m, Nm/rad]
    inertia: Array  # (2,) [kg, kg m^2]
    dead_band: Array  # (2,) [N, Nm]
    limit: Array  # (2,) [m, rad]
    damping_ratio: float
    filter_time: float  # [s]
    member: Array  # (n, nv) 1 where a joint moves the arm's tool


class AdmittanceData(NamedTuple):
    """What is measured of each arm, and how its target is displaced. World axes at the tool's origin."""

    tau: Array  # (nv,) external torque [Nm]
    J: Array  # (n, 6, nv) tool Jacobians
    follows: Array  # (n,) 1 where the arm has a target
    wrench: Array  # (n, 6) after the low-pass [N, Nm]
    x: Array  # (n, 6) displacement [m, rad]
    v: Array  # (n, 6) [m/s, rad/s]
    estimate: Array  # (6,) scratch
    square: Array  # (6, 6)
    directions: Array  # (6, 6)

    @classmethod
    def empty(cls, arms: int, nv: int) -> AdmittanceData:
        return cls(
            tau=np.zeros(nv),
            J=np.zeros((arms, 6, nv)),
            follows=np.zeros(arms),
            wrench=np.zeros((arms, 6)),
            x=np.zeros((arms, 6)),
            v=np.zeros((arms, 6)),
            estimate=np.zeros(6),
            square=np.zeros((6, 6)),
            directions=np.zeros((6, 6)),
        )


@kernel
def step_admittance(held_model: Held, held_data: Held, measured: int, dt: float) -> None:
    """Move every arm's displacement by ``dt`` [s].

    ``measured``: TOUCHED with ``tau`` and ``J`` filled in, NOT_MEASURED for no touch, UNUSABLE to hold the wrench.
    """
    model, arms = borrowed(held_model), borrowed(held_data)
    share = 1.0 - np.exp(-dt / model.filter_time) if model.filter_time > 0.0 else 1.0
    for i in range(arms.x.shape[0]):
        if measured == TOUCHED:
            estimate_wrench(arms.J[i], arms.tau, model.member[i], arms.square, arms.directions, arms.estimate)
        elif measured == NOT_MEASURED:
            arms.estimate[:] = 0.0
        for k in range(6):
            if measured != UNUSABLE:
                arms.wrench[i, k] += share * (arms.estimate[k] - arms.wrench[i, k])
            if arms.follows[i] == 0.0:
                arms.x[i, k] = 0.0
                arms.v[i, k] = 0.0
        if arms.follows[i] == 1.0:
            still = True
            for part in range(2):
                still &= _displace(model, part, arms.wrench[i], arms.x[i], arms.v[i], dt)
            if still:
                arms.x[i] = 0.0
                arms.v[i] = 0.0


@kernel
def _displace(model: AdmittanceModel, part: int, wrench: Array, x: Array, v: Array, dt: float) -> bool:
    """Move three of the six components; whether they are as good as zero and stay so."""
    first = 3 * part
    size = _length(wrench, first)
    band, stiffness = model.dead_band[part], model.stiffness[part]
    pull = 0.0  # rest displacement, as a part of the wrench
    if size > band:
        pull = min((1.0 - (band / size) ** 2) / stiffness, model.limit[part] / size)
    frequency = np.sqrt(stiffness / model.inertia[part])
    still = pull == 0.0
    for k in range(first, first + 3):
        rest = pull * wrench[k]
        away, v[k] = oscillate(x[k] - rest, v[k], frequency, model.damping_ratio, dt)
        x[k] = rest + away
        still &= abs(x[k]) < _NOTHING and abs(v[k]) < _NOTHING
    length = _length(x, first)
    if length > model.limit[part]:
        # At the limit, without speed outwards.
        outwards = 0.0
        for k in range(first, first + 3):
            outwards += x[k] / length * v[k]
        for k in range(first, first + 3):
            v[k] -= max(outwards, 0.0) * x[k] / length
            x[k] *= model.limit[part] / length
    return still


@kernel
def _length(vector: Array, first: int) -> float:
    return np.sqrt(vector[first] ** 2 + vector[first + 1] ** 2 + vector[first + 2] ** 2)


@kernel
def oscillate(x: float, v: float, frequency: float, damping_ratio: float, dt: float) -> tuple[float, float]:
    """Exact x and v after ``dt`` [s] of  x'' + 2 xi w x' + w^2 x = 0,  w the undamped ``frequency`` [rad/s]."""
    fall = damping_ratio * frequency
    spread = frequency * np.sqrt(abs(damping_ratio**2 - 1.0))
    # e^-fall t times cos or cosh, and sin or sinh over spread; written so that nothing overflows.
    if spread * dt < 1e-6:
        cosine = np.exp(-fall * dt)
        sine = cosine * dt
    elif damping_ratio < 1.0:
        cosine = np.exp(-fall * dt) * np.cos(spread * dt)
        sine = np.exp(-fall * dt) * np.sin(spread * dt) / spread
    else:
        slow, fast = np.exp((spread - fall) * dt), np.exp(-(spread + fall) * dt)
        cosine = 0.5 * (slow + fast)
        sine = 0.5 * (slow - fast) / spread
    return (cosine + fall * sine) * x + sine * v, (cosine - fall * sine) * v - frequency**2 * sine * x


@kernel
def estimate_wrench(J: Array, tau: Array, member: Array, square: Array, directions: Array, wrench: Array) -> None:
    """Least-squares wrench (6,) for joint torques ``tau`` (nv,) [Nm] of the joints that are ``member`` (nv,).

    ``J`` (6, nv); ``square`` and ``directions`` (6, 6) are scratch. By J J' = V s^2 V', F = V f(s) V' J tau.
    """
    for row in range(6):
        wrench[row] = 0.0
        for column in range(6):
            square[row, column] = 0.0
        for j in range(tau.shape[0]):
            if member[j] == 0.0:
                continue
            wrench[row] += _scale(row) * J[row, j] * tau[j]
            for column in range(6):
                square[row, column] += _scale(row) * J[row, j] * _scale(column) * J[column, j]
    _diagonalise(square, directions)
    for k in range(6):
        along = 0.0
        for row in range(6):
            along += directions[row, k] * wrench[row]
        value = max(square[k, k], 0.0)
        deficit = max(1.0 - value / _SINGULAR**2, 0.0)
        square[k, k] = along / (value + (_SINGULAR * deficit) ** 2)
    for row in range(6):
        wrench[row] = 0.0
        for k in range(6):
            wrench[row] += _scale(row) * directions[row, k] * square[k, k]


@kernel
def _scale(row: int) -> float:
    return 1.0 if row < 3 else ROTATION_LENGTH


@kernel
def _diagonalise(square: Array, directions: Array) -> None:
    """Eigenvalues onto the diagonal of a symmetric matrix, eigenvectors into columns of ``directions``.

    Cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 2013, section 8.5).
    """
    n = square.shape[0]
    for i in range(n):
        for j in range(n):
            directions[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        beside = 0.0
        on = 0.0
        for i in range(n):
            on += square[i, i] ** 2
            for j in range(i):
                beside += square[i, j] ** 2
        if beside <= _DIAGONAL * on:
            return
        for p in range(n - 1):
            for q in range(p + 1, n):
                _rotate(square, directions, p, q)


@kernel
def _rotate(square: Array, directions: Array, p: int, q: int) -> None:
    """Bring ``square[p, q]`` to zero by a rotation of rows and columns p and q."""
    if square[p, q] == 0.0:
        return
    ratio = (square[q, q] - square[p, p]) / (2.0 * square[p, q])
    tangent = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
    if ratio < 0.0:
        tangent = -tangent
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(square.shape[0]):
        a, b = square[k, p], square[k, q]
        square[k, p] = cosine * a - sine * b
        square[k, q] = sine * a + cosine * b
        a, b = directions[k, p], directions[k, q]
        directions[k, p] = cosine * a - sine * b
        directions[k, q] = sine * a + cosine * b
    for k in range(square.shape[0]):
        a, b = square[p, k], square[q, k]
        square[p, k] = cosine * a - sine * b
        square[q, k] = sine * a + cosine * b
