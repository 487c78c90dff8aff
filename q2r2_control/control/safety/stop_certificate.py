"""The stopping motion and the certificate that it keeps every pair apart, compiled.

**Stop.** Each joint brakes at its full deceleration a to rest: q_j(t) = q_j + v_j t - sign(v_j) a_j t^2 / 2 until
t_j = |v_j| / a_j. It keeps every joint limit (limits.py) and, being a function of time, is the same motion whatever
the length of the ticks it is executed in.

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
no room for, plane.py has a proof that knows directions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.collision import Bodies, Contact, Pairs, Posed, measure, pose_bodies
from q2r2_control.control.geometry.kinematics import Chain, Placements, place
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.separating_plane import step_keeps_beyond
from q2r2_control.types import Array

_DEEPEST = 6  # halvings of the stop: 64 intervals
# A pair that starts closer than min_distance may not come closer; this is rounding only.
_ROUNDING = 1e-12  # [m]


class Rollout(NamedTuple):
    """Scratch of :func:`certify`: samples of the stop at up to 2^deepest + 1 instants."""

    q: Array  # (s, nv)
    v: Array  # (nv,)
    start: Array  # (s, g, 3)
    end: Array  # (s, g, 3)
    rotation: Array  # (s, g, 3, 3)
    distance: Array  # (s,)
    known: Array  # (s,) 1 where the sample's bodies are posed
    way: Array  # (2, nv) of each joint during the step, then during the stop [rad]
    placements: Placements
    contact: Contact

    @classmethod
    def empty(cls, chain: Chain, bodies: Bodies) -> Rollout:
        samples, nv, g = 2**_DEEPEST + 1, len(chain.parent) - 1, len(bodies.joint)
        return cls(
            np.zeros((samples, nv)),
            np.zeros(nv),
            np.zeros((samples, g, 3)),
            np.zeros((samples, g, 3)),
            np.zeros((samples, g, 3, 3)),
            np.zeros(samples),
            np.zeros(samples),
            np.zeros((2, nv)),
            Placements.empty(chain),
            Contact.empty(),
        )


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
def stop_together(
    q: Array, v: Array, lower: Array, upper: Array, a: Array, longest: float, deceleration: Array
) -> bool:
    """Decelerations (nv,) with which all joints stop at the same time, the first of them at its limit ``a``.

    Returns False where that leaves no room to a position limit. The room includes a step of the ``longest`` time, as
    in limits.py, and what is left of it during the stop does too: then every state of the stop keeps P.
    """
    duration = 0.0
    for j in range(q.shape[0]):
        duration = max(duration, abs(v[j]) / a[j])
    for j in range(q.shape[0]):
        deceleration[j] = abs(v[j]) / duration if v[j] != 0.0 else a[j]
        end = q[j] + v[j] * (0.5 * duration + longest)
        if (v[j] > 0.0 and end > upper[j]) or (v[j] < 0.0 and end < lower[j]):
            return False
    return True


@lean_kernel
def step_way(v: float, v_next: float, h: float) -> float:
    """Way a joint travels in a step of constant acceleration, there and back counted."""
    if v * v_next >= 0.0:
        return 0.5 * abs(v + v_next) * h
    return 0.5 * (v * v + v_next * v_next) / (abs(v) + abs(v_next)) * h


@lean_kernel
def _sample(
    chain: Chain, bodies: Bodies, q: Array, v: Array, a: Array, duration: float, i: int, rollout: Rollout
) -> None:
    """Pose all bodies at sample ``i`` of the stop, once."""
    if rollout.known[i] == 1.0:
        return
    brake(q, v, a, duration * i / (rollout.q.shape[0] - 1), rollout.q[i], rollout.v)
    place(chain, rollout.q[i], rollout.placements)
    pose_bodies(bodies, rollout.placements, Posed(rollout.start[i], rollout.end[i], rollout.rotation[i]))
    rollout.known[i] = 1.0


@lean_kernel
def _stop_keeps_apart(
    chain: Chain,
    bodies: Bodies,
    pairs: Pairs,
    p: int,
    q: Array,
    v: Array,
    a: Array,
    duration: float,
    threshold: float,
    rollout: Rollout,
) -> bool:
    """Prove pair ``p`` apart along the whole stop, with as few samples as it takes."""
    last = rollout.q.shape[0] - 1
    stride = last
    measured = 0
    while stride >= 1:
        proven = True
        previous = -1
        for i in range(0, last + 1, stride):
            if measured == 0 or (i // stride) % 2 == 1:
                _sample(chain, bodies, q, v, a, duration, i, rollout)
                posed = Posed(rollout.start[i], rollout.end[i], rollout.rotation[i])
                rollout.distance[i] = _distance(bodies, pairs, p, posed, rollout)
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
def certify(
    chain: Chain,
    placements: Placements,
    bodies: Bodies,
    pairs: Pairs,
    distance: Array,
    posed: Posed,
    v: Array,
    q_next: Array,
    v_next: Array,
    a: Array,
    h: float,
    min_distance: float,
    rollout: Rollout,
) -> bool:
    """Whether the step to (q_next, v_next) in ``h`` and the full stop from there keep every pair apart.

    ``distance`` (p,) holds distances, or lower bounds of them, before the step, where joint frames have ``placements``
    and bodies are ``posed``; a bound that does not suffice is replaced by the distance. A pair that is closer than
    ``min_distance`` already must not come closer at the step's end and during the stop.
    """
    rollout.known[:] = 0.0
    duration = 0.0
    for j in range(v.shape[0]):
        duration = max(duration, abs(v_next[j]) / a[j])
        rollout.way[0, j] = step_way(v[j], v_next[j], h)
        rollout.way[1, j] = v_next[j] * v_next[j] / (2.0 * a[j])
    for p in range(pairs.first.shape[0]):
        step = 0.0
        stop = 0.0
        for k in range(pairs.joint.shape[1]):
            joint = pairs.joint[p, k]
            if joint == 0:
                break
            step += pairs.reach[p, k] * rollout.way[0, joint - 1]
            stop += pairs.reach[p, k] * rollout.way[1, joint - 1]
        if distance[p] - step - stop >= min_distance:
            continue
        if distance[p] < min_distance:
            if not _comes_no_closer(chain, bodies, pairs, p, distance[p], q_next, v_next, a, duration, rollout):
                return False
            continue
        _sample(chain, bodies, q_next, v_next, a, duration, 0, rollout)
        after = _distance(bodies, pairs, p, Posed(rollout.start[0], rollout.end[0], rollout.rotation[0]), rollout)
        if after < min_distance:
            return False
        if 0.5 * (distance[p] + after - step) < min_distance:
            distance[p] = _distance(bodies, pairs, p, posed, rollout)
            if 0.5 * (distance[p] + after - step) < min_distance and not step_keeps_beyond(
                chain, placements, bodies, posed, pairs, p, rollout.contact, v, v_next, h, rollout.way[0], min_distance
            ):
                return False
        if after - stop >= min_distance:
            continue
        if not _stop_keeps_apart(chain, bodies, pairs, p, q_next, v_next, a, duration, min_distance, rollout):
            return False
    return True


@lean_kernel
def _comes_no_closer(
    chain: Chain,
    bodies: Bodies,
    pairs: Pairs,
    p: int,
    distance: float,
    q: Array,
    v: Array,
    a: Array,
    duration: float,
    rollout: Rollout,
) -> bool:
    """For a pair that is too close already: no sample of the stop is closer than the one before."""
    before = distance
    for i in range(rollout.q.shape[0]):
        _sample(chain, bodies, q, v, a, duration, i, rollout)
        now = _distance(bodies, pairs, p, Posed(rollout.start[i], rollout.end[i], rollout.rotation[i]), rollout)
        if now < before - _ROUNDING:
            return False
        before = now
    return True


@lean_kernel
def _distance(bodies: Bodies, pairs: Pairs, p: int, posed: Posed, rollout: Rollout) -> float:
    first = pairs.first[p]
    return measure(bodies, posed, first, pairs.second[p], posed.start[first], posed.end[first], rollout.contact)
