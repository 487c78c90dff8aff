"""Joint limits as one interval of next velocities per joint, never empty.

The reference moves with constant acceleration during a step h <= H (H is the longest step):

    v+ = v + a h,    q+ = q + (v + v+) h / 2.

**Claim.** Let r be the room to the upper limit. If a state satisfies

    P:  v <= 0 and r >= 0,  or  v^2 / (2 a) + H v <= r,

then full braking keeps P for any h in (0, H], and the interval below contains full braking, hence is not empty.

*Proof.* Let v > 0. If v >= a h, braking gives w = v - a h and r' = r - v h + a h^2 / 2. Then
w^2/(2a) + H w = v^2/(2a) + H v - v h + a h^2/2 - a h H <= r - v h + a h^2/2 - a h H <= r'. If v < a h, braking gives
w = 0 and r' = r - v h / 2 >= v^2/(2a) + H v - v h / 2 >= 0 because h <= H. If v <= 0, r' >= r. The bound is the largest
v+ for which P holds after the step, so every v+ at or below it that the acceleration allows keeps P. Velocity and
acceleration intervals contain full braking too, and by symmetry so does the bound for the lower limit. Between two
steps q stays inside as well: a velocity that changes sign within a step travels at most |v| h / 2 <= H |v|. []

A state that starts outside P (beyond a limit, too fast to stop, above the velocity limit) has no interval that keeps
every limit. Then the acceleration limit wins, and the joint brakes and returns inward at bounded speed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import kernel
from q2r2_control.types import Array

# Inward speed per radian outside, and how far inside the return aims so that it ends after finite time.
_RETURN_GAIN = 4.0  # [1/s]
_RETURN_DEPTH = 1e-3  # [rad]

NO_LIMIT, POSITION, VELOCITY, ACCELERATION = 0, 1, 2, 3  # what may hold a joint back


class JointLimits(NamedTuple):
    """The limits that every joint keeps."""

    lower: Array  # (nv,) positions, the margin taken off [rad]
    upper: Array  # (nv,)
    velocity: Array  # (nv,) [rad/s]
    acceleration: Array  # (nv,) [rad/s^2]
    longest_step: float  # H [s]
    return_speed: float  # inward, of a joint outside its limits [rad/s]


class VelocityBox(NamedTuple):
    """Interval of next velocities per joint, and which limit makes each side of it."""

    lower: Array  # (nv,) [rad/s]
    upper: Array  # (nv,)
    lower_limit: IntArray  # (nv,) POSITION, VELOCITY or ACCELERATION
    upper_limit: IntArray  # (nv,)

    @classmethod
    def empty(cls, nv: int) -> VelocityBox:
        return cls(*np.zeros((2, nv)), *np.zeros((2, nv), dtype=np.int64))


@kernel
def fastest_towards(room: float, v: float, a: float, h: float, longest: float, return_speed: float) -> float:
    """Largest next velocity towards a limit [rad/s] that keeps P, given the ``room`` to it [rad]; see the proof above.

    It solves w^2/(2a) + (H + h/2) w = room - v h / 2 for w. Outside the limit it asks for motion inward.
    """
    remaining = room - 0.5 * v * h
    if room < 0.0:
        return -min(return_speed, _RETURN_GAIN * (_RETURN_DEPTH - room))
    if remaining < 0.0:
        return 0.0
    c = longest + 0.5 * h
    # The root written without the difference of two nearly equal numbers.
    return 2.0 * remaining / (c + np.sqrt(c * c + 2.0 * remaining / a))


@kernel
def next_velocity_box(limits: JointLimits, q: Array, v: Array, h: float, box: VelocityBox) -> bool:
    """Fill ``box`` for a step of ``h`` from ``q`` [rad] and ``v`` [rad/s], (nv,) each.

    Returns False where some joint is outside P, that is, recovers.
    """
    inside = True
    for j in range(q.shape[0]):
        a = limits.acceleration[j]
        slowest, fastest = v[j] - a * h, v[j] + a * h
        up = fastest_towards(limits.upper[j] - q[j], v[j], a, h, limits.longest_step, limits.return_speed)
        down = -fastest_towards(q[j] - limits.lower[j], -v[j], a, h, limits.longest_step, limits.return_speed)
        box.lower_limit[j] = POSITION if down > -limits.velocity[j] else VELOCITY
        box.upper_limit[j] = POSITION if up < limits.velocity[j] else VELOCITY
        up = min(up, limits.velocity[j])
        down = max(down, -limits.velocity[j])
        if up < slowest or down > fastest or up < down:
            # A last bit lost to rounding is not recovery.
            scale = 1e-9 * (1.0 + abs(v[j]))
            if up < slowest - scale or down > fastest + scale or up < down - scale:
                inside = False
        if limits.upper[j] < q[j] or q[j] < limits.lower[j]:
            inside = False
        if fastest < up:
            box.upper_limit[j] = ACCELERATION
        if slowest > down:
            box.lower_limit[j] = ACCELERATION
        box.upper[j] = clamp(up, slowest, fastest)
        box.lower[j] = min(clamp(down, slowest, fastest), box.upper[j])
    return inside
