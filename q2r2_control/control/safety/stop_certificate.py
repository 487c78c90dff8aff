"""The stopping motion and the certificate that it keeps every pair apart, compiled.

**Stop.** Each joint brakes at its full deceleration a to rest: q_j(t) = q_j + v_j t - sign(v_j) a_j t^2 / 2 until
t_j = |v_j| / a_j. It keeps every joint limit (joint_limits.py) and, being a function of time, is the same motion
whatever the length of the ticks it is executed in.

Out of a position that is too close the joints stop together instead, each at the deceleration that takes as long as the
slowest one's: then the stop runs straight on in joint space, and a pair that was opening goes on opening, while joints
that stop one after the other turn the motion, and may close it. Its room to position limits is checked, not proven.

**Certificate.** A tick moves the reference along a parabola to (q+, v+) and must know that the parabola and the stop
from (q+, v+) keep every pair at min_distance. Then by induction the robot is always safe: the last tick's certified
stop can be executed now, and what is left of it needs no new check.

**Between samples.** A point of a body is never farther than reach_j from joint j's axis, so while the joints travel
ways w_j (total variation) a pair's distance changes by at most S = sum_j reach_j w_j over the joints that move one body
relative to the other. Between two samples with distances d1 and d2 it is therefore at least (d1 + d2 - S) / 2: going
down from d1 and up to d2 uses up S. One sample already proves d1 - S, enough for most pairs. For a step that S leaves
no room for, separating_plane.py has a proof that knows directions.
"""

from __future__ import annotations

from q2r2_control.control.geometry.collision import CollisionData, Posed, update_placements
from q2r2_control.control.geometry.pair_distance import measure
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.joint_limits import JointLimits
from q2r2_control.control.safety.safety_data import Candidate, SafetyData
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.control.safety.separating_plane import step_keeps_beyond
from q2r2_control.types import Array

# A pair that starts closer than min_distance may not come closer; this is rounding only.
_ROUNDING = 1e-12  # [m]


@lean_kernel
def brake(q: Array, v: Array, a: Array, t: float, q_out: Array, v_out: Array) -> None:
    """State of the stop after ``t`` seconds, from (q, v) with decelerations a > 0, (nv,) each."""
    for j in range(q.shape[0]):
        speed = abs(v[j])
        sign = 1.0 if v[j] >= 0.0 else -1.0
        if speed <= a[j] * t:
            q_out[j] = q[j] + sign * speed * speed / (2.0 * a[j])
            v_out[j] = 0.0
        else:
            q_out[j] = q[j] + v[j] * t - sign * 0.5 * a[j] * t * t
            v_out[j] = v[j] - sign * a[j] * t


@lean_kernel
def stop_together(limits: JointLimits, candidate: Candidate) -> bool:
    """Write decelerations with which all joints stop at the same time, the first of them at its limit.

    Returns False where that leaves no room to a position limit. The room includes a step of the longest time, as in
    joint_limits.py, and what is left of it during the stop does too: then every state of the stop keeps P.
    """
    q, v, a = candidate.q, candidate.v, limits.acceleration
    duration = 0.0
    for j in range(q.shape[0]):
        duration = max(duration, abs(v[j]) / a[j])
    for j in range(q.shape[0]):
        candidate.deceleration[j] = abs(v[j]) / duration if v[j] != 0.0 else a[j]
        end = q[j] + v[j] * (0.5 * duration + limits.longest_step)
        if (v[j] > 0.0 and end > limits.upper[j]) or (v[j] < 0.0 and end < limits.lower[j]):
            return False
    return True


@lean_kernel
def step_travel(v: float, v_next: float, h: float) -> float:
    """Way a joint travels in a step of constant acceleration, there and back counted."""
    if v * v_next >= 0.0:
        return 0.5 * abs(v + v_next) * h
    return 0.5 * (v * v + v_next * v_next) / (abs(v) + abs(v_next)) * h


@lean_kernel
def certify(model: SafetyModel, data: SafetyData, h: float) -> bool:
    """Whether the step to ``data.candidate`` in ``h`` and the full stop from there keep every pair apart.

    ``data.distance`` holds distances at the reference, or lower bounds of them; a bound that does not suffice is
    replaced by the distance. A pair that is closer than min_distance already must not come closer at the step's end and
    during the stop.
    """
    pairs, rollout, distance = model.collision.pairs, data.rollout, data.distance
    duration = _begin_rollout(data, h)
    for p in range(pairs.first.shape[0]):
        step = 0.0
        stop = 0.0
        for k in range(pairs.joint.shape[1]):
            joint = pairs.joint[p, k]
            if joint == 0:
                break
            step += pairs.reach[p, k] * rollout.step_travel[joint - 1]
            stop += pairs.reach[p, k] * rollout.stop_travel[joint - 1]
        if distance[p] - step - stop >= model.min_distance:
            continue
        if distance[p] < model.min_distance:
            if not _comes_no_closer(model, data, p, duration):
                return False
            continue
        after = _distance_at(model, data, p, 0, duration)
        if after < model.min_distance:
            return False
        if 0.5 * (distance[p] + after - step) < model.min_distance:
            distance[p] = measure(model.collision, data.collision, p)
            if 0.5 * (distance[p] + after - step) < model.min_distance and not step_keeps_beyond(
                model, data, p, h, model.min_distance
            ):
                return False
        if after - stop >= model.min_distance:
            continue
        if not _stop_keeps_apart(model, data, p, duration):
            return False
    return True


@lean_kernel
def _begin_rollout(data: SafetyData, h: float) -> float:
    """Forget the last candidate's samples, find how far the joints travel; returns the stop's duration [s]."""
    candidate, rollout, v = data.candidate, data.rollout, data.state.v
    rollout.known[:] = 0.0
    duration = 0.0
    for j in range(v.shape[0]):
        duration = max(duration, abs(candidate.v[j]) / candidate.deceleration[j])
        rollout.step_travel[j] = step_travel(v[j], candidate.v[j], h)
        rollout.stop_travel[j] = candidate.v[j] * candidate.v[j] / (2.0 * candidate.deceleration[j])
    return duration


@lean_kernel
def _distance_at(model: SafetyModel, data: SafetyData, p: int, i: int, duration: float) -> float:
    """Distance of pair ``p`` at sample ``i`` of the candidate's stop; all bodies are placed there once."""
    candidate, rollout = data.candidate, data.rollout
    posed = Posed(rollout.start[i], rollout.end[i], rollout.rotation[i])
    sample = CollisionData(rollout.placements, posed, rollout.contact)
    if rollout.known[i] == 0.0:
        t = duration * i / (rollout.q.shape[0] - 1)
        brake(candidate.q, candidate.v, candidate.deceleration, t, rollout.q[i], rollout.v)
        update_placements(model.collision, sample, rollout.q[i])
        rollout.known[i] = 1.0
    return measure(model.collision, sample, p)


@lean_kernel
def _stop_keeps_apart(model: SafetyModel, data: SafetyData, p: int, duration: float) -> bool:
    """Prove pair ``p`` apart along the whole stop, with as few samples as it takes."""
    pairs, rollout, threshold = model.collision.pairs, data.rollout, model.min_distance
    last = rollout.q.shape[0] - 1
    stride = last
    measured = 0
    while stride >= 1:
        proven = True
        previous = -1
        for i in range(0, last + 1, stride):
            if measured == 0 or (i // stride) % 2 == 1:
                rollout.distance[i] = _distance_at(model, data, p, i, duration)
                if rollout.distance[i] < threshold:
                    return False
            if previous >= 0:
                way = 0.0
                for k in range(pairs.joint.shape[1]):
                    joint = pairs.joint[p, k]
                    if joint == 0:
                        break
                    way += pairs.reach[p, k] * abs(rollout.q[i, joint - 1] - rollout.q[previous, joint - 1])
                if 0.5 * (rollout.distance[i] + rollout.distance[previous] - way) < threshold:
                    proven = False
            previous = i
        if proven:
            return True
        measured = 1
        stride //= 2
    return False


@lean_kernel
def _comes_no_closer(model: SafetyModel, data: SafetyData, p: int, duration: float) -> bool:
    """For a pair that is too close already: no sample of the stop is closer than the one before."""
    before = data.distance[p]
    for i in range(data.rollout.q.shape[0]):
        now = _distance_at(model, data, p, i, duration)
        if now < before - _ROUNDING:
            return False
        before = now
    return True
