"""Write the rows of the QP that keep monitored pairs apart.

The rows tell the QP what the certified stop can do. Let B be the least free distance of a pair during this stop,

    B = min over the stop of  d - min_distance - buffer.

A step may use up only a share of B: B(q+, v+) >= (1 - gain h) B(q, v). This is a control barrier function that is built
from a backup manoeuvre (Gurriet, Mote, Ames, Feron, CDC 2018). A motion during which the pair's distance stays the same
uses up nothing and is not slowed. A motion that brings the pair closer is slowed early enough. The rows are
linearised at those instants of the stop at which the free distance is least, or may soon be least, so that rows do not
appear and disappear from tick to tick. At an instant with more free distance than B, the step may also use up the
difference, at a rate of 50 /s.

A stop takes the time T. At its time t, joints that stop together have travelled v s, with s = t - t^2 / 2T. If the stop
after the step takes T too, the step changes the posture at the time t by D q, and the row is

    D q = h (v + v+) / 2 + s (v+ - v),    n'(J_2 - J_1) D q >= -gain h B.

For a pair at rest this is the usual row, n'(J_2 - J_1) v+ >= -gain B. The factor of v+ is called the lever. It is the
same for all joints and all shapes of a stop, so that the row has the direction of the pair's normal. With a separate
lever for each joint, the direction of the row would change from tick to tick with the shape.

If a pair is closer than its buffer, the row asks it to open, as fast as a part of the acceleration limits allows. Pairs
that may touch have a ``min_distance`` below zero. Around contact they have a zone in which they use up B no faster than
at their contact speed. Safety does not depend on the rows, because the certificate alone keeps the arms safe. The rows
are soft, so that the QP always has a solution.

**The gain may change between any two ticks.** The certificate reads no row and no gain. It reads distances, and a lower
bound of a distance proves less, never more. The executed part of a solution is therefore certified for every gain.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import dot, segment_segment, size_of, way_between
from q2r2_control.control.geometry.collision import CollisionData
from q2r2_control.control.geometry.pair_distance import distance_row, measure, measure_part
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.safety.following_rows import append_following_row
from q2r2_control.control.safety.safety_data import INSTANTS, SafetyData, SafetyModel
from q2r2_control.control.safety.separating_plane import curvature
from q2r2_control.control.safety.stop_rollout import begin_rollout, sample_of, stay_with_stop
from q2r2_control.types import Array


class StopTime(NamedTuple):
    """The instant of the stop for which a row is written."""

    # True if the pair is measured at the start of the stop, and its motion until the end is computed along the tangent.
    along: bool
    h: float  # Duration of the step [s].
    lever: float  # How far a joint moves until the instant, per unit of its next velocity [s].
    least: float  # B, the least free distance of the pair during the stop [m].
    ahead: float  # Time that the row looks ahead: half of the stop, and 1 / gain [s].


_SHARE = 0.25  # Share of the acceleration limits that a row may use to open a pair.
# An end of a near-parallel capsule gets a row of its own if it is farther than this from the closest point.
_SAME_POINT = 0.005  # [m]
# An instant gets a row if its distance exceeds the least distance by no more than this. Without this tolerance, rows
# would switch between instants from tick to tick.
_SAME_DISTANCE = 0.002  # [m]
# If a stop bends the paths of a pair's points by less than this, its rows use the tangent at the start of the stop.
_STRAIGHT = 1e-5  # [m]
# Rate at which a step may use up the difference, if an instant has more free distance than B [1/s].
_CATCH_UP = 50.0


@kernel
def write_separation_rows(model: SafetyModel, data: SafetyData, h: float) -> None:
    """Write the rows that can bind in a step of ``h`` [s]. Each row has unit norm.

    The pairs have to be measured at the reference before this call. The candidate and its rollout are overwritten
    with the certified stop.
    """
    stay_with_stop(data)
    duration = begin_rollout(data)
    stop = data.rollout.stop.travel
    count = 0
    for p in range(data.near.shape[0]):
        if data.near[p] == 0:
            continue
        straight = curvature(model.collision.pairs, p, stop, stop, 0.0) < _STRAIGHT
        least = _distances_ahead(model, data, p, duration, straight)
        for i in range(len(INSTANTS)):
            t = duration * INSTANTS[i] / INSTANTS[-1]
            s = t - 0.5 * t * t / duration if duration > 0.0 else 0.0
            # From rest, a step to v+ moves a joint by h v+ / 2. The stop after this step moves it by at most h v+ / 2.
            lever = max(s, 0.5 * h) + 0.5 * h
            if data.rows.ahead[i] > least + _SAME_DISTANCE or (i > 0 and lever <= h):
                continue
            along = straight and i > 0
            at = data.collision if i == 0 or along else sample_of(model, data, INSTANTS[i], duration)
            distance = measure(model.collision, at, p)
            moment = StopTime(
                along, h, lever, least - model.approach.stop_distance[p], 0.5 * duration + 1.0 / model.approach.gain[0]
            )
            before = count
            count = _append_row(model, data, at, p, distance, moment, count)
            if count > before:
                count = _append_end_rows(model, data, at, p, distance, moment, count)
        if data.history.window[0] > 0.0 and model.of_two_arms[p] == 1:
            count = append_following_row(model, data, p, h, duration, model.approach.gain[0], count)
    data.rows.used[0] = count


@kernel
def _distances_ahead(model: SafetyModel, data: SafetyData, p: int, duration: float, straight: bool) -> float:
    """Write the distance [m] of pair ``p`` at each instant; return the least distance. Skipped instants get infinity.

    If the paths are ``straight``, the pair is nearest at the start or at the end of the stop. If the pair is too close,
    only the start counts, because the pair has to open from its present position.
    """
    ahead, last = data.rows.ahead, len(INSTANTS) - 1
    ahead[:] = np.inf
    ahead[0] = measure(model.collision, data.collision, p)
    if ahead[0] < model.min_distance[p]:
        return ahead[0]
    if straight:
        row = data.rows.matrix[-1]  # The last row is never in use, and serves as a buffer.
        distance_row(model.collision, data.collision, p, row)
        ahead[last] = ahead[0] + _tangent(data, row)
        return min(ahead[0], ahead[last])
    least = ahead[0]
    for i in range(1, last + 1):
        ahead[i] = measure(model.collision, sample_of(model, data, INSTANTS[i], duration), p)
        least = min(least, ahead[i])
    return least


@inlined_kernel
def _tangent(data: SafetyData, row: Array) -> float:
    """Return by how much the certified stop opens the pair whose gradient is ``row`` (nv,), along the tangent [m]."""
    v, change = data.state.v, 0.0
    for j in range(row.shape[0]):
        change += row[j] * 0.5 * v[j] * abs(v[j]) / data.certified[j]
    return change


@kernel
def _append_row(
    model: SafetyModel, data: SafetyData, at: CollisionData, p: int, distance: float, moment: StopTime, count: int
) -> int:
    """Add a row if some velocity that the acceleration limit allows (v +- a h) breaks it; other rows cannot bind.

    Pair ``p`` was measured in ``at``, which is the posture at the ``moment``. If ``moment.along`` is True, it is the
    posture at the start of the stop, from which the row computes the end of the stop along the tangent. The row gets
    unit norm, so that its violation is a joint speed.
    """
    h = moment.h
    a, v, row, lever = model.limits.acceleration, data.state.v, data.rows.matrix[count], moment.lever
    distance_row(model.collision, at, p, row)
    free = distance - model.approach.stop_distance[p]
    if moment.along:
        free += _tangent(data, row)
    rate = dot(row, v)  # Change of the distance, and of B, per second at constant v [m/s].
    change = 0.0  # Largest change of the distance at the moment that accelerations in the step can cause [m].
    for j in range(row.shape[0]):
        change += abs(row[j]) * a[j]
    change *= h * lever
    gain = model.approach.gain[0]
    beyond_least = max(free - moment.least, 0.0)
    allowed = -gain * h * min(free, moment.least) - min(_CATCH_UP * h, 1.0) * beyond_least
    slow = model.approach.contact_speed[p]
    if slow < np.inf:
        allowed = max(allowed, -h * max(slow, gain * (free - model.approach.contact_zone[p])))
    if free < 0.0:
        # If rows asked for more than the joints can do, the QP would weigh them against each other. The distance of a
        # pair that is much too close would then grow, and the distance of another pair would fall.
        allowed = min(allowed, model.approach.recovery_speed * h, max(h * rate, 0.0) + _SHARE * change)
    if h * rate - change >= allowed or change <= 0.0:
        return count
    size = size_of(row)
    row /= size
    data.rows.lower[count] = (rate + (allowed - h * rate) / lever) / size
    data.rows.pair[count] = p
    return count + 1


@kernel
def _append_end_rows(
    model: SafetyModel, data: SafetyData, at: CollisionData, p: int, distance: float, moment: StopTime, count: int
) -> int:
    """Add rows for those ends of both bodies that may soon be as close to the other body as ``distance`` [m].

    The closest points of near-parallel bodies jump from one end to the other end. With rows for the ends, no row jumps.
    An end gets no row if the bodies turn too slowly to bring it that close within ``moment.ahead``. Pair ``p`` was
    measured in ``at``.
    """
    bodies, posed, contact, angular = model.collision.bodies, at.posed, at.contact, data.velocities.angular
    first, second = model.collision.pairs.first[p], model.collision.pairs.second[p]
    start, end, closest = posed.start[first], posed.end[first], contact.kept
    for k in range(3):
        closest[0, k], closest[1, k] = contact.first[k], contact.second[k]
    turned = way_between(angular[bodies.joint[first]], angular[bodies.joint[second]]) * moment.ahead
    for point in (start, end):
        apart = way_between(point, closest[0])
        if apart < _SAME_POINT:
            continue
        reached = measure_part(model.collision, at, p, point, point)
        if reached <= distance + turned * apart + _SAME_POINT:
            count = _append_row(model, data, at, p, reached, moment, count)
    if bodies.box[second] == 1:
        return count
    for point in (posed.start[second], posed.end[second]):
        apart = way_between(point, closest[1])
        if apart < _SAME_POINT:
            continue
        cores = segment_segment(start, end, point, point, contact.first, contact.second)
        reached = cores - bodies.radius[first] - bodies.radius[second]
        if cores > 1e-9 and reached <= distance + turned * apart + _SAME_POINT:
            for k in range(3):
                contact.normal[k] = (contact.second[k] - contact.first[k]) / cores
            count = _append_row(model, data, at, p, reached, moment, count)
    return count
