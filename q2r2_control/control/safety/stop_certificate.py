"""The certificate that a step and the full stop after it keep every pair apart (compiled).

**Certificate.** A tick moves the reference along a parabola to (q+, v+). Two motions must keep every pair at its
distance: this parabola, and a stop from (q+, v+) of one of the shapes in stop_rollout.py. The robot is then always safe
by induction: the certified stop of the last tick can be executed now, and what remains of it needs no new check.

**Between samples.** A point of a body is never farther than reach_j from the axis of joint j. Let joint j travel w_j
(total variation). The distance of a pair then changes by at most S = sum_j reach_j w_j over the joints that move one
body relative to the other. One sample with the distance d therefore proves that the distance stays at least d - S. For
pairs that share no joint, the speeds of their bodies at the reference give a better bound (speed_bound.py), which
suffices for most pairs. If it does not suffice, the plane between the bodies is used, which takes the direction of
motion into account (separating_plane.py). The stop is then checked in parts. Each part begins at a sample, and is as
long as can be proven from this sample.

**Rounding.** A motion that is proven to end exactly at the required distance of a pair may end 1e-16 m below it. If a
pair is below its required distance by less than ROUNDING, the full proof uses the present distance of the pair instead.
Rounding therefore never leads to recovery, in which a pair is only checked at samples.
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

# If the distance of a pair that is too close falls by less than this between two samples, the fall counts as rounding
# [m]. The same number is a relative tolerance for times.
_CLOSER = 1e-12
_STILL = 1e-9  # If a pair that is too close approaches more slowly than this, it counts as standing still [m/s].
_NOISE = 1e-15  # By rounding, two measurements of the same distance may differ by this [m].
# Accuracy of the closest points of a box and a segment. The gap along the normal of the plane between the box and the
# segment may be smaller than their distance by this. Without the tolerance, a pair that is exactly at its required
# distance could never be proven to move apart again.
_LAST_DIGITS = 1e-11  # [m]


@kernel
def step_travel(v: float, v_next: float, h: float) -> float:
    """Return the length of a joint's path in a step with constant acceleration [rad or m]."""
    if v * v_next >= 0.0:
        return 0.5 * abs(v + v_next) * h
    return 0.5 * (v * v + v_next * v_next) / (abs(v) + abs(v_next)) * h


@kernel
def certify(model: SafetyModel, data: SafetyData, h: float) -> bool:
    """Return whether the step to ``data.candidate`` in ``h`` [s] and the full stop after it keep every pair apart.

    ``data.distance`` has the distances at the reference or lower bounds of them. A bound that does not suffice is
    replaced by the distance. ``data.velocities`` has the velocities at the reference. A pair that is too close must not
    come closer, at the end of the step and during the stop. ``data.unproven`` gets the index of the pair that failed.
    """
    duration = begin_rollout(data)
    write_step(data, h)
    time = write_deviations(model, data, h, duration)
    history = data.history
    apart = history.window[0] > 0.0
    if apart:
        write_way(model, data, h, duration)
    farthest = 0.0  # Longest travel of a joint in the step and the stop, or in the window before [rad or m].
    for j in range(data.rollout.step.travel.shape[0]):
        farthest = max(farthest, data.rollout.step.travel[j] + data.rollout.stop.travel[j], history.travel[j])
    for p in range(data.distance.shape[0]):
        if data.distance[p] - model.collision.pairs.leverage[p] * farthest >= model.min_distance[p]:
            continue  # No joint travels farther than ``farthest``, so the pair keeps its distance.
        alone = apart and model.of_two_arms[p] == 1  # Then each of the two arms can be anywhere on its path.
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
    """Return whether pair ``p`` is closer at the reference than its required distance.

    ``data.distance`` is exact for near pairs. For other pairs it is a lower bound, which is not below the required
    distance.
    """
    return data.distance[p] < model.min_distance[p] - ROUNDING


@kernel
def _keeps_apart(model: SafetyModel, data: SafetyData, p: int, h: float, duration: float, alone: bool) -> bool:
    """Return whether pair ``p`` is proven to keep its distance in the step and the stop: with one plane, or in parts.

    With ``alone`` the proof also holds for arms that move and stop at different times.
    """
    data.distance[p] = measure(model.collision, data.collision, p)
    if data.distance[p] < model.min_distance[p] - 0.5 * ROUNDING and not _comes_no_closer(
        model, data, p, duration, _NOISE
    ):
        return False  # Without this test, the tolerance in ``threshold`` could add up from tick to tick.
    threshold = min(model.min_distance[p], data.distance[p] - _LAST_DIGITS)
    if alone:  # This proof includes the case in which both arms move at the same time.
        return keeps_apart_at_any_time(model, data, p, duration, threshold)
    if stays_beyond(model.collision, data.collision, p, data.rollout.step, h, data.rollout.stop, duration, threshold):
        return True
    if not _step_keeps_apart(model, data, p, h, duration, threshold):
        return False
    return _stop_keeps_apart(model, data, p, duration, threshold)


@kernel
def write_step(data: SafetyData, h: float) -> None:
    """Write the parabola from the reference to the candidate."""
    v, v_next, piece = data.state.v, data.candidate.v, data.rollout.step
    for j in range(v.shape[0]):
        piece.rate[j] = v[j]
        piece.change[j] = (v_next[j] - v[j]) / h if h > 0.0 else 0.0
        piece.travel[j] = step_travel(v[j], v_next[j], h)


@inlined_kernel
def _has_room(model: SafetyModel, data: SafetyData, p: int, time: float) -> bool:
    """Return whether pair ``p`` keeps its distance, by a simple bound on how much closer it can come.

    The bound is computed from the speeds of its bodies, or from the travel of the joints if the bodies share a joint.
    """
    if model.collision.pairs.carried[p] == 0:
        return least_distance(model, data, p, time) >= model.min_distance[p]
    step, stop = way(model, p, data.rollout.step.travel), way(model, p, data.rollout.stop.travel)
    return data.distance[p] - step - stop >= model.min_distance[p]


@kernel
def _step_keeps_apart(
    model: SafetyModel, data: SafetyData, p: int, h: float, duration: float, threshold: float
) -> bool:
    """Return whether pair ``p`` is proven to keep its distance in the step.

    The proof uses the distances at both ends and the travel of the joints, or else a plane at the start.
    """
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
    """Return whether pair ``p`` is proven to keep its distance during the whole stop, part by part."""
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
    """Return whether a pair that is too close comes no closer during the stop.

    At each sample, its distance must not be smaller than at the sample before, and must not be falling. Distances alone
    would miss a pair that opens and closes again between two samples. At the last sample all joints rest. The joints
    that came to rest last are then taken with their velocities one sample earlier.
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
