"""Choose the deceleration of each joint in a stop, and compute samples of the stop: its postures at instants that are
evenly spaced in time (compiled). All pairs share the samples. A sample is computed when it is first needed.

**Claim.** If a state satisfies P (joint_limits.py), a stop of each shape keeps P until the joint rests, and no joint
brakes harder than its acceleration limit a.

*Proof.* In the shape OWN, each joint brakes fully, and joint_limits.py proves the claim. In the other shapes, the joint
with the greatest |v| / a brakes fully. Let another joint have v > 0, and let r be the distance to its upper limit. By
P, r - H v >= v^2 / (2 a) > 0. The joint brakes with a deceleration d for which v^2 / (2 (r - H v)) <= d <= a. When its
velocity has fallen to w, its distance to the limit is

    r' = r - (v^2 - w^2) / (2 d) >= H v + w^2 / (2 d) >= H w + w^2 / (2 a),

which is P. The same holds for v < 0 and the lower limit. []
"""

from __future__ import annotations

from q2r2_control.control.geometry.collision import CollisionData, update_placements
from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_pointers import pointee_at
from q2r2_control.control.safety.joint_limits import JointLimits
from q2r2_control.control.safety.safety_data import QuadraticPiece, SafetyData, SafetyModel
from q2r2_control.types import Array

# The shapes of a stop. TOGETHER: all joints come to rest at the same time. ARM_BY_ARM: the joints of each arm come to
# rest at the same time. OWN: each joint brakes fully.
TOGETHER, ARM_BY_ARM, OWN = 0, 1, 2
SHAPES = 3


@kernel
def write_stop(model: SafetyModel, q: Array, v: Array, shape: int, deceleration: Array) -> None:
    """Write the ``deceleration`` (nv,) [rad/s^2] of each joint in a stop from ``q`` [rad] and ``v`` [rad/s] (nv,).

    ``shape`` is TOGETHER, ARM_BY_ARM or OWN.
    """
    a = model.limits.acceleration
    for j in range(v.shape[0]):
        deceleration[j] = a[j]
        if shape == OWN:
            continue
        leader = j
        for i in range(v.shape[0]):
            same = shape == TOGETHER or model.arm[i] == model.arm[j]
            if same and abs(v[i]) * a[leader] > abs(v[leader]) * a[i]:
                leader = i
        if leader != j and v[j] != 0.0:
            shared = abs(v[j]) * a[leader] / abs(v[leader])
            deceleration[j] = min(max(shared, _least_deceleration(model.limits, j, q[j], v[j])), a[j])


@kernel
def _least_deceleration(limits: JointLimits, j: int, q: float, v: float) -> float:
    """Return the least constant deceleration of joint ``j`` that keeps its position limits until the joint rests.

    The condition P of joint_limits.py holds in this motion. If no deceleration keeps P, return the joint's acceleration
    limit.
    """
    room = (limits.upper[j] - q if v > 0.0 else q - limits.lower[j]) - limits.longest_step * abs(v)
    if room <= 0.0:
        return limits.acceleration[j]
    return min(0.5 * v * v / room, limits.acceleration[j])


@kernel
def brake(q: Array, v: Array, deceleration: Array, t: float, q_out: Array, v_out: Array) -> None:
    """Write the state at ``t`` [s] after the start of a stop from (q, v), with decelerations above 0 (nv,)."""
    for j in range(q.shape[0]):
        speed = abs(v[j])
        sign = 1.0 if v[j] >= 0.0 else -1.0
        if speed <= deceleration[j] * t:
            q_out[j] = q[j] + sign * speed * speed / (2.0 * deceleration[j])
            v_out[j] = 0.0
        else:
            q_out[j] = q[j] + v[j] * t - sign * 0.5 * deceleration[j] * t * t
            v_out[j] = v[j] - sign * deceleration[j] * t


# A joint that comes to rest less than this before the end of an interval counts as moving until the end [s]. This is
# far more than the rounding of times. The error of the joint's travel is d t^2 / 2, about 1e-17 rad.
_SAME_TIME = 1e-9


@kernel
def begin_rollout(data: SafetyData) -> float:
    """Forget the samples of the last stop, and write ``rollout.stop`` of the candidate; return its duration [s]."""
    candidate, rollout = data.candidate, data.rollout
    rollout.known[:] = 0.0
    duration = 0.0
    for j in range(candidate.v.shape[0]):
        duration = max(duration, abs(candidate.v[j]) / candidate.deceleration[j])
    write_piece(data, candidate.v, 0.0, duration, rollout.stop)
    return duration


@kernel
def stay_with_stop(data: SafetyData) -> None:
    """Copy the present reference and the known stop into the candidate."""
    for j in range(data.state.v.shape[0]):
        data.candidate.q[j] = data.state.q[j]
        data.candidate.v[j] = data.state.v[j]
        data.candidate.deceleration[j] = data.certified[j]


@kernel
def sample_of(model: SafetyModel, data: SafetyData, i: int, duration: float) -> CollisionData:
    """Return the placements of the bodies at sample ``i`` of the candidate's stop."""
    candidate, rollout = data.candidate, data.rollout
    sample = pointee_at(rollout.samples, i)
    if rollout.known[i] == 0.0:
        t = duration * i / (rollout.q.shape[0] - 1)
        brake(candidate.q, candidate.v, candidate.deceleration, t, rollout.q[i], rollout.v[i])
        update_placements(model.collision, sample, rollout.q[i])
        rollout.known[i] = 1.0
    return sample


@kernel
def write_piece(data: SafetyData, v: Array, start: float, length: float, piece: QuadraticPiece) -> None:
    """Write the motion in a part of the candidate's stop.

    The motion of a joint that comes to rest in this part is not one parabola. Only its two ends are used.

    Args:
        data: The data.
        v: Velocities at the start of the part (nv,) [rad/s].
        start: Start of the part, from the beginning of the stop [s].
        length: Duration of the part [s].
        piece: The motion is written here.
    """
    candidate = data.candidate
    for j in range(v.shape[0]):
        deceleration = candidate.deceleration[j]
        sign = 1.0 if v[j] >= 0.0 else -1.0
        rest = abs(candidate.v[j]) / deceleration - start  # The time until the joint rests.
        piece.rate[j], piece.change[j], piece.loose[j] = 0.0, 0.0, 0.0
        if v[j] == 0.0:
            piece.travel[j] = 0.0
        elif rest < length - _SAME_TIME:
            piece.travel[j] = 0.5 * v[j] * v[j] / deceleration
            piece.loose[j] = sign * piece.travel[j]
        else:
            piece.rate[j] = v[j]
            piece.change[j] = -sign * deceleration
            piece.travel[j] = abs(v[j]) * length - 0.5 * deceleration * length * length
