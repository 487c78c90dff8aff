"""The certificate that a step and the full stop after it keep every pair apart, compiled.

**Certificate.** A tick moves the reference along a parabola to (q+, v+). Two motions must keep every pair at its
distance: the parabola, and a stop from (q+, v+) of one of the shapes in stop_rollout.py. Then by induction the robot is
always safe. The last tick's certified stop can be executed now, and the rest of it needs no new check.

**Between samples.** A point of a body is never farther than reach_j from joint j's axis. While the joints travel ways
w_j (total variation) a pair's distance therefore changes by at most S = sum_j reach_j w_j over the joints that move one
body relative to the other. One sample with distance d proves d - S. Of pairs that share no joint more is known: how
fast their bodies are at the reference (speed_bound.py), enough for most. Where it is not, the plane between the bodies
proves a piece of the motion, with the direction of it (separating_plane.py). The stop is walked through in pieces as
long as can be proven, each from a sample of its own.

**Rounding.** A motion that is proven to end exactly at a pair's distance may end 1e-16 m below it. Within ROUNDING
below its distance a pair keeps its full proof, with the distance that it has now as the one to keep. Rounding therefore
never leads into recovery, where a pair is only sampled.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.pair_distance import distance_row, measure
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.safety.arm_skew import is_far, keeps_apart_at_any_time, write_way
from q2r2_control.control.safety.safety_data import ROUNDING, SafetyData, SafetyModel
from q2r2_control.control.safety.separating_plane import stays_beyond
from q2r2_control.control.safety.speed_bound import least_distance, way, write_deviations
from q2r2_control.control.safety.stop_rollout import begin_rollout, sample_of, write_piece

# Distances of a pair that is too close are compared to this.
_CLOSER = 1e-12  # [m], and relative
_STILL = 1e-9  # [m/s]
_NOISE = 1e-15  # of a distance that is measured twice [m]
# The gap along a plane is less than the distance that it is made of by up to this much. The closest points of a box and
# a segment are found to so many digits. Without it a pair at its distance could never be proven to part again.
_LAST_DIGITS = 1e-11  # [m]


@kernel
def step_travel(v: float, v_next: float, h: float) -> float:
    """Way a joint travels in a step of constant acceleration, there and back counted."""
    if v * v_next >= 0.0:
        return 0.5 * abs(v + v_next) * h
    return 0.5 * (v * v + v_next * v_next) / (abs(v) + abs(v_next)) * h


@kernel
def certify(model: SafetyModel, data: SafetyData, h: float) -> bool:
    """Whether the step to ``data.candidate`` in ``h`` and the full stop from there keep every pair apart.

    ``data.distance`` holds distances at the reference, or lower bounds of them; a bound that does not suffice is
    replaced by the distance. ``data.velocities`` are those at the reference, of the bodies as they are now. A pair that
    is too close already must not come closer at the step's end and during the stop. ``data.unproven``: what failed.
    """
    duration = begin_rollout(data)
    write_step(data, h)
    time = write_deviations(model, data, h, duration)
    history = data.history
    apart = history.window[0] > 0.0
    if apart:
        write_way(model, data, h, duration)
    farthest = 0.0  # longest travel of a joint in the step and the stop, or in the window before [rad or m]
    for j in range(data.rollout.step.travel.shape[0]):
        farthest = max(farthest, data.rollout.step.travel[j] + data.rollout.stop.travel[j], history.travel[j])
    for p in range(data.distance.shape[0]):
        if data.distance[p] - model.collision.pairs.leverage[p] * farthest >= model.min_distance[p]:
            continue  # no joint travels farther, so the way is no longer
        alone = apart and model.of_two_arms[p] == 1  # each of the two may be anywhere on its way
        if is_far(model, data, p, time) if alone else _has_room(model, data, p, time):
            continue
        data.unproven[0] = p
        if is_too_close(model, data, p):
            if not _comes_no_closer(model, data, p, duration, _CLOSER):
                return False
        elif not _keeps_apart(model, data, p, h, duration, alone):
            return False
    return True


@inlined_kernel
def is_too_close(model: SafetyModel, data: SafetyData, p: int) -> bool:
    """Whether pair ``p``, whose distance at the reference is exact where this matters, is in penetration."""
    return data.distance[p] < model.min_distance[p] - ROUNDING


@kernel
def _keeps_apart(model: SafetyModel, data: SafetyData, p: int, h: float, duration: float, alone: bool) -> bool:
    """Prove pair ``p`` apart in the step and in the stop: with one plane, or else piece by piece.

    ``alone``: also where its arms go and stop at different times.
    """
    data.distance[p] = measure(model.collision, data.collision, p)
    if data.distance[p] < model.min_distance[p] - 0.5 * ROUNDING and not _comes_no_closer(
        model, data, p, duration, _NOISE
    ):
        return False  # or the digits below would add up, tick by tick, to more than rounding
    threshold = min(model.min_distance[p], data.distance[p] - _LAST_DIGITS)
    if alone:  # this proof includes the case in which both arms move at the same time
        return keeps_apart_at_any_time(model, data, p, duration, threshold)
    if stays_beyond(model.collision, data.collision, p, data.rollout.step, h, data.rollout.stop, duration, threshold):
        return True
    if not _step_keeps_apart(model, data, p, h, duration, threshold):
        return False
    return _stop_keeps_apart(model, data, p, duration, threshold)


@kernel
def write_step(data: SafetyData, h: float) -> None:
    """The parabola from the reference to the candidate."""
    v, v_next, piece = data.state.v, data.candidate.v, data.rollout.step
    for j in range(v.shape[0]):
        piece.rate[j] = v[j]
        piece.change[j] = (v_next[j] - v[j]) / h if h > 0.0 else 0.0
        piece.travel[j] = step_travel(v[j], v_next[j], h)


@inlined_kernel
def _has_room(model: SafetyModel, data: SafetyData, p: int, time: float) -> bool:
    """Whether pair ``p`` is farther apart than it can come closer: by its speed; by the ways if it shares a joint."""
    if model.collision.pairs.carried[p] == 0:
        return least_distance(model, data, p, time) >= model.min_distance[p]
    step, stop = way(model, p, data.rollout.step.travel), way(model, p, data.rollout.stop.travel)
    return data.distance[p] - step - stop >= model.min_distance[p]


@kernel
def _step_keeps_apart(
    model: SafetyModel, data: SafetyData, p: int, h: float, duration: float, threshold: float
) -> bool:
    """Prove pair ``p`` apart in the step: from both of its ends by the way, or else from the first by a plane."""
    after = measure(model.collision, sample_of(model, data, 0, duration), p)
    if after < threshold:
        return False
    if 0.5 * (data.distance[p] + after - way(model, p, data.rollout.step.travel)) >= threshold:
        return True
    measure(model.collision, data.collision, p)
    step = data.rollout.step
    return stays_beyond(model.collision, data.collision, p, step, h, step, 0.0, threshold)


@kernel
def _stop_keeps_apart(model: SafetyModel, data: SafetyData, p: int, duration: float, threshold: float) -> bool:
    """Prove pair ``p`` apart along the whole stop, piece by piece."""
    rollout = data.rollout
    i, last = 0, rollout.q.shape[0] - 1
    stride = last
    while i < last:
        sample = sample_of(model, data, i, duration)
        distance = measure(model.collision, sample, p)
        if distance < threshold:
            return False
        rest = 0.0
        for k in range(model.collision.pairs.joint.shape[1]):
            joint = model.collision.pairs.joint[p, k]
            if joint == 0:
                break
            v = rollout.v[i, joint - 1]
            rest += model.collision.pairs.reach[p, k] * 0.5 * v * v / data.candidate.deceleration[joint - 1]
        if distance - rest >= threshold:
            return True
        stride = min(4 * stride, last)
        while stride > last - i or i % stride != 0:
            stride //= 2
        while stride >= 1:
            length = duration * stride / last
            write_piece(data, rollout.v[i], duration * i / last, length, rollout.piece)
            if stays_beyond(model.collision, sample, p, rollout.piece, length, rollout.piece, 0.0, threshold):
                break
            stride //= 2
        if stride < 1:
            return False
        i += stride
    return True


@kernel
def _comes_no_closer(model: SafetyModel, data: SafetyData, p: int, duration: float, closer: float) -> bool:
    """For a pair that is too close already: no sample of the stop is closer than the one before, or closing in.

    Distances alone would miss a pair that opens and closes again between two samples. At the last one all joints rest,
    and the way by which the last of them came counts.
    """
    candidate, row = data.candidate, data.rollout.piece.rate
    before = data.distance[p]
    last = data.rollout.q.shape[0] - 1
    for i in range(last + 1):
        sample = sample_of(model, data, i, duration)
        now = measure(model.collision, sample, p)
        if now < before - closer:
            return False
        before = now
        distance_row(model.collision, sample, p, row)
        rate = 0.0
        for j in range(row.shape[0]):
            v = data.rollout.v[i, j]
            if i == last and abs(candidate.v[j]) >= (1.0 - _CLOSER) * duration * candidate.deceleration[j]:
                v = np.sign(candidate.v[j]) * candidate.deceleration[j] * duration / last
            rate += row[j] * v
        if rate < -_STILL:
            return False
    return True
