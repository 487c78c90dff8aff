"""Write the rows of the QP that keep monitored pairs apart.

The rows tell the QP what the certified stop can do. Let B be the least free distance of a pair on this stop,

    B = min over the stop of  d - min_distance - buffer.

A step may use up only a share of it: B(q+, v+) >= (1 - gain h) B(q, v). This is a control barrier function made of a
backup manoeuvre (Gurriet, Mote, Ames, Feron, CDC 2018). Motion that keeps its distance uses up nothing and is not
slowed. Motion that closes in is slowed in time for the stop. B is linearised at the instants of the stop at which it is
least, or may soon be, so that rows do not come and go from tick to tick. The free distance beyond B may be used up at
50 /s. If a stop takes T, joints that stop together have travelled v s at its time t, with s = t - t^2 / 2T. With the
same T after the step,

    D q = h (v + v+) / 2 + s (v+ - v),    n'(J_2 - J_1) D q >= -gain h B.

For a pair at rest this is the usual row, n'(J_2 - J_1) v+ >= -gain B. The change of speed has the same lever for all
joints and shapes of stop, so that the row is along the normal of the pair. With a lever for each joint its direction
would change from tick to tick with the shape.

If a pair is closer than its buffer, the row asks it to open, as fast as a part of the acceleration limits allows. Pairs
that may touch have a distance below zero. Around contact they have a zone in which B is used up no faster than at their
own speed. The rows are for comfort only. They are soft, so that the QP always has a solution, and the certificate alone
keeps the arms safe.

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
    """The moment of the stop at which a row looks at its pair."""

    along: bool  # True if the pair is measured at the start of the stop, and the row follows the tangent to its end.
    h: float  # Duration of the step [s].
    lever: float  # Way until the moment per next speed [s].
    least: float  # B, the least free distance of the pair on the stop [m].
    ahead: float  # Time that the row looks ahead: half of the stop, and 1 / gain [s].


_SHARE = 0.25
# An end of a near-parallel capsule gets a row of its own if it is farther than this from the closest point.
_SAME_POINT = 0.005  # [m]
# An instant gets a row already if its distance is greater than the least one by less than this. Otherwise rows would
# switch from tick to tick.
_SAME_DISTANCE = 0.002  # [m]
# If a stop bends the ways of a pair's points by less than this, the row looks along the tangent at its start.
_STRAIGHT = 1e-5  # [m]
# Rate at which instants other than the nearest one may use up their additional free distance [1/s].
_CATCH_UP = 50.0


@kernel
def write_separation_rows(model: SafetyModel, data: SafetyData, h: float) -> None:
    """Write the rows of pairs that can bind in a step of ``h`` [s] from the measured reference, with unit norm.

    The candidate and its rollout are used for the certified stop.
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
            # At rest a faster step lengthens the stop by as much as the step itself.
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
    """Write the distance of pair ``p`` at each instant, infinite for instants that are skipped; returns the least [m].

    On a straight way the pair is nearest at one of both ends. A pair that is too close has to open from where it is.
    """
    ahead, last = data.rows.ahead, len(INSTANTS) - 1
    ahead[:] = np.inf
    ahead[0] = measure(model.collision, data.collision, p)
    if ahead[0] < model.min_distance[p]:
        return ahead[0]
    if straight:
        row = data.rows.matrix[-1]  # The last row is never in use, and serves as scratch.
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
    """Return by how much the certified stop opens a pair with the given ``row`` along the tangent [m]."""
    v, change = data.state.v, 0.0
    for j in range(row.shape[0]):
        change += row[j] * 0.5 * v[j] * abs(v[j]) / data.certified[j]
    return change


@kernel
def _append_row(
    model: SafetyModel, data: SafetyData, at: CollisionData, p: int, distance: float, moment: StopTime, count: int
) -> int:
    """Add a row if some velocity that the acceleration limit allows (v +- a h) breaks it; other rows cannot bind.

    Pair ``p`` was measured in ``at``, the posture at the ``moment``, or at the start of a straight stop whose end the
    row sees along the tangent. The row gets unit norm, so that its violation is a joint speed.
    """
    h = moment.h
    a, v, row, lever = model.limits.acceleration, data.state.v, data.rows.matrix[count], moment.lever
    distance_row(model.collision, at, p, row)
    free = distance - model.approach.stop_distance[p]
    if moment.along:
        free += _tangent(data, row)
    rate = dot(row, v)  # Change of the distance, and of B, per second at constant v [m/s].
    change = 0.0  # By how much the acceleration can change this in the step [m].
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
        # Rows that ask for more than the joints can do would be weighed against each other. A deep pair would then open
        # at the cost of closing another one.
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
    """Add rows at those ends of both bodies of a pair that may soon be as close as its ``distance``.

    The closest points of near-parallel bodies jump from end to end. With rows at the ends, no row jumps. An end gets no
    row if the bodies cannot turn it as close as that within the time that the row looks ahead. The pair was measured in
    ``at``.
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
