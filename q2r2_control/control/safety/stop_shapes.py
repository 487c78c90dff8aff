"""Shapes of a full stop: with which decelerations the joints come to rest, compiled.

A stop is a constant deceleration d_j <= a_j per joint: q_j(t) = q_j + v_j t - sign(v_j) d_j t^2 / 2 until it rests at
t_j = |v_j| / d_j. Being a function of time, it is the same motion whatever the length of the ticks it is executed in.
Which d_j are best depends on what is near.

- Together, d_j = |v_j| / T with the time T of the slowest joint: straight on in joint space. Arms that move alike stop
  alike, and what keeps its distance or opens goes on doing so.
- Arm by arm, the same with a time of its own for each arm, so that a fast arm does not make the stop of a slow one,
  close to a table, longer.
- On its own, d_j = a_j: the shortest way of every joint. But joints that rest one after the other bend the way of the
  tool, sideways into what it slides along.

**Position limits.** In a stop with the constant deceleration d a joint's room r to the limit ahead shrinks by the way
v^2 / 2d - w^2 / 2d while its speed falls from v to w, and joint_limits.py's P asks w^2 / 2a + H w <= r' at each moment.
With d <= a it is enough that v^2 / 2d + H v <= r, for then w^2/2a + H w <= w^2/2d + H w <= r - v^2/2d + w^2/2d = r'. So
d_j is raised to v_j^2 / 2 (r_j - H |v_j|) where T would ask for less. P itself says that this is at most a_j: every
shape keeps every limit, and none has to be given up for want of room. [] (A joint outside P takes a_j.)
"""

from __future__ import annotations

from q2r2_control.control.jit import kernel
from q2r2_control.control.safety.joint_limits import JointLimits
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.types import Array

TOGETHER, ARM_BY_ARM, OWN = 0, 1, 2
SHAPES = 3


@kernel
def write_stop(model: SafetyModel, q: Array, v: Array, shape: int, deceleration: Array) -> None:
    """Write the ``deceleration`` of a stop of the given shape from ``q`` [rad], ``v`` [rad/s], (nv,) each [rad/s^2]."""
    a = model.limits.acceleration
    for j in range(v.shape[0]):
        deceleration[j] = a[j]
    if shape == OWN:
        return
    for j in range(v.shape[0]):
        leader = j
        for i in range(v.shape[0]):
            same = shape == TOGETHER or model.arm[i] == model.arm[j]
            if same and abs(v[i]) * a[leader] > abs(v[leader]) * a[i]:
                leader = i
        speed = abs(v[j])
        if leader == j or speed == 0.0:
            continue
        shared = speed * a[leader] / abs(v[leader])
        deceleration[j] = min(max(shared, _least_deceleration(model.limits, j, q[j], v[j])), a[j])


@kernel
def _least_deceleration(limits: JointLimits, j: int, q: float, v: float) -> float:
    """Least constant deceleration of joint ``j`` that keeps P until it rests; its limit where none does."""
    room = (limits.upper[j] - q if v > 0.0 else q - limits.lower[j]) - limits.longest_step * abs(v)
    if room <= 0.0:
        return limits.acceleration[j]
    return min(0.5 * v * v / room, limits.acceleration[j])


@kernel
def brake(q: Array, v: Array, deceleration: Array, t: float, q_out: Array, v_out: Array) -> None:
    """State of the stop after ``t`` seconds, from (q, v) with decelerations > 0, (nv,) each."""
    for j in range(q.shape[0]):
        speed = abs(v[j])
        sign = 1.0 if v[j] >= 0.0 else -1.0
        if speed <= deceleration[j] * t:
            q_out[j] = q[j] + sign * speed * speed / (2.0 * deceleration[j])
            v_out[j] = 0.0
        else:
            q_out[j] = q[j] + v[j] * t - sign * 0.5 * deceleration[j] * t * t
            v_out[j] = v[j] - sign * deceleration[j] * t
