"""The law of the admittance: see :class:`Admittance`.

**The wrench.** The torques that a tool wrench F (force, torque; world axes, at the tool frame's origin) makes in the
joints are tau = J' F, seven numbers for six unknowns. Every left inverse of J' returns a wrench at the tool exactly;
they differ in what they make of noise, of model error and of contacts elsewhere on the arm. The pseudo-inverse
(J')^+ has, of all of these, the least variance where the joints' errors are alike (Gauss and Markov), and needs no
mass matrix, whose masses are not known to better than a factor of two. Forces along which the arm is stretched out
load its bearings and not its joints: directions with a singular value s below a threshold e are damped one by one,
1/s becoming s / (s^2 + e^2 (1 - s^2/e^2)^2) (in the manner of Maciejewski and Klein, J. Robotic Systems 1988), with
metres and radians made comparable by a length. All other directions stay exact. A first-order low-pass smooths the
wrench, and a dead band takes out the rest: F (1 - (b / |F|)^2) above the band b, 0 below, which is continuous and,
unlike F - b, soon equal to F, at 7 b to 2 %; in the band's neighbourhood the tool is at most twice as soft as asked.

**The motion.**  M x'' + D x' + K x = F,  D = 2 xi sqrt(K M), for the displacement x (3,) in world axes, and alike
for the rotation vector that turns the tool. It is integrated exactly for a wrench that is constant over the tick, by
the closed solution of the oscillator: stable for every dt, with the damping ratio that was asked for at every dt.
"""

from __future__ import annotations

import math

import numpy as np

from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array

_METRES = np.array([1.0, 1.0, 1.0, *[ROTATION_LENGTH] * 3])
# Of J with rotations times ROTATION_LENGTH: a direction below it counts as singular, since a torque error of 0.1 Nm
# is worth 2 N there [m].
_SINGULAR = 0.05


def estimate_wrench(J: Array, tau: Array) -> Array:
    """Least-squares wrench (6,) for the torques ``tau`` (n,) [Nm] of an arm's joints with the Jacobian J (6, n).

    By J J' = V s^2 V', F = V f(s) V' J tau.
    """
    scaled = _METRES[:, None] * J
    values, directions = np.linalg.eigh(scaled @ scaled.T)
    values = np.maximum(values, 0.0)
    deficit = np.maximum(1.0 - values / _SINGULAR**2, 0.0)
    along = directions.T @ (scaled @ tau)
    wrench: Array = _METRES * (directions @ (along / (values + (_SINGULAR * deficit) ** 2)))
    return wrench


def rest_displacement(force: Array, dead_band: float, stiffness: float, limit: float) -> Array:
    """Displacement (3,) at which the spring bears a force or torque (3,), after the dead band, within ``limit``."""
    size = math.hypot(*force)
    if size <= dead_band:
        return np.zeros(3)
    return np.asarray(force * min((1.0 - (dead_band / size) ** 2) / stiffness, limit / size))


def stop_at_limit(x: Array, v: Array, limit: float) -> tuple[Array, Array]:
    """A displacement and its speed, (3,) each, no farther than ``limit``, and there without speed outwards."""
    length = math.hypot(*x)
    if length <= limit:
        return x, v
    out = x / length
    return limit * out, v - max(float(out @ v), 0.0) * out


def oscillate(x: Array, v: Array, frequency: float, damping_ratio: float, dt: float) -> tuple[Array, Array]:
    """Exact x and v after ``dt`` [s] of  x'' + 2 xi w x' + w^2 x = 0,  w the undamped ``frequency`` [rad/s]."""
    fall = damping_ratio * frequency
    spread = frequency * math.sqrt(abs(damping_ratio**2 - 1.0))
    # e^-fall t times cos or cosh, and sin or sinh over spread; written so that nothing overflows.
    if spread * dt < 1e-6:
        cosine = math.exp(-fall * dt)
        sine = cosine * dt
    elif damping_ratio < 1.0:
        cosine = math.exp(-fall * dt) * math.cos(spread * dt)
        sine = math.exp(-fall * dt) * math.sin(spread * dt) / spread
    else:
        slow, fast = math.exp((spread - fall) * dt), math.exp(-(spread + fall) * dt)
        cosine = 0.5 * (slow + fast)
        sine = 0.5 * (slow - fast) / spread
    return (cosine + fall * sine) * x + sine * v, (cosine - fall * sine) * v - frequency**2 * sine * x
