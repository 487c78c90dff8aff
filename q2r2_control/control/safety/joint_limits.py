"""Turn joint limits into one interval of next velocities per joint, which is never empty.

The reference moves with constant acceleration during a step h <= H (H is the longest step):

    v+ = v + a h,    q+ = q + (v + v+) h / 2.

**Claim.** Let r be the distance to the upper limit. If a state satisfies

    P:  v <= 0 and r >= 0,  or  v^2 / (2 a) + H v <= r,

then full braking keeps P for any h in (0, H], and the interval below contains full braking, hence is not empty.

*Proof.* Let v > 0. If v >= a h, braking gives the velocity w = v - a h and the distance r' = r - v h + a h^2 / 2. Then
w^2/(2a) + H w = v^2/(2a) + H v - v h + a h^2/2 - a h H <= r - v h + a h^2/2 - a h H <= r'. If v < a h, braking gives
w = 0 and r' = r - v h / 2 >= v^2/(2a) + H v - v h / 2 >= 0 because h <= H. If v <= 0, r' >= r. The bound is the largest
v+ for which P holds after the step. Every v+ at or below it that the acceleration limit allows therefore keeps P. The
intervals of the velocity and acceleration limits contain full braking too, and by symmetry so does the bound for the
lower limit. Between two steps q stays inside as well, because a velocity that changes its sign within a step travels at
most |v| h / 2 <= H |v|. []

For a state outside P (beyond a limit, too fast to stop, above the velocity limit), no interval keeps every limit. Only
the acceleration limit is then kept. The joint brakes, and returns inward at bounded speed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import kernel
from q2r2_control.types import Array

_RETURN_GAIN = 4.0  # Inward speed per radian outside of the limit [1/s].
# A joint beyond its limit is moved to this far inside of the limit, so that it crosses the limit in finite time [rad].
_RETURN_DEPTH = 1e-3

NO_LIMIT, POSITION, VELOCITY, ACCELERATION = 0, 1, 2, 3  # The kinds of limits that may limit the velocity of a joint.


class JointLimits(NamedTuple):
    """The limits that every joint keeps."""

    lower: Array  # (nv,) Least positions, with the margin [rad].
    upper: Array  # (nv,) Greatest positions, with the margin [rad].
    velocity: Array  # (nv,) [rad/s]
    acceleration: Array  # (nv,) [rad/s^2]
    longest_step: float  # The longest step H of the proof above [s].
    return_speed: float  # Inward speed of a joint outside its limits [rad/s].


class VelocityBox(NamedTuple):
    """The interval of next velocities of each joint, and the kind of limit at each of its ends."""

    lower: Array  # (nv,) [rad/s]
    upper: Array  # (nv,) [rad/s]
    lower_limit: IntArray  # (nv,) POSITION, VELOCITY or ACCELERATION.
    upper_limit: IntArray  # (nv,) POSITION, VELOCITY or ACCELERATION.

    @classmethod
    def empty(cls, nv: int) -> VelocityBox:
        return cls(*np.zeros((2, nv)), *np.zeros((2, nv), dtype=np.int64))


@kernel
def fastest_towards(room: float, v: float, a: float, h: float, longest: float, return_speed: float) -> float:
    """Return the largest next velocity towards a limit that keeps the condition P of the proof above [rad/s].

    It is the solution w of w^2/(2a) + (H + h/2) w = room - v h / 2. Outside the limit it is negative, a motion inward.

    Args:
        room: Distance to the limit [rad].
        v: Present velocity towards the limit [rad/s].
        a: Acceleration limit [rad/s^2].
        h: Duration of the step [s].
        longest: The longest step H [s].
        return_speed: Greatest inward speed outside the limit [rad/s].
    """
    remaining = room - 0.5 * v * h
    if room < 0.0:
        return -min(return_speed, _RETURN_GAIN * (_RETURN_DEPTH - room))
    if remaining < 0.0:
        return 0.0
    c = longest + 0.5 * h
    # This form of the root has no difference of two nearly equal numbers.
    return 2.0 * remaining / (c + np.sqrt(c * c + 2.0 * remaining / a))


@kernel
def next_velocity_box(limits: JointLimits, q: Array, v: Array, h: float, box: VelocityBox) -> bool:
    """Write ``box`` for a step of ``h`` [s] from ``q`` (nv,) [rad] and ``v`` (nv,) [rad/s].

    Returns False if a joint violates the condition P of the module's docstring, so that it recovers.
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
            # A joint that violates the condition P only by rounding does not count as recovering.
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
