"""Rows of the QP that keep monitored pairs apart.

The rows tell the QP what the stop can do. Let B be the least free distance of a pair on the certified stop from here,

    B = min over the stop of  d - min_distance - buffer.

It may be used up no faster than at a rate, B(q+, v+) >= (1 - gain h) B(q, v). This is a control barrier function made
of a backup manoeuvre (Gurriet, Mote, Ames, Feron, CDC 2018). Motion that keeps its distance uses up nothing and is not
slowed; motion that closes in is slowed in time for the stop. B is linearised at the instants of the stop where it is
least, or may soon be, so that no row comes and goes from tick to tick. The rest beyond B may be used up at 50 /s. At t
of a stop that takes T joints that stop together have travelled v s, s = t - t^2 / 2T. With the same T after the step,

    D q = h (v + v+) / 2 + s (v+ - v),    n'(J_2 - J_1) D q >= -gain h B.

For a pair at rest this is the usual row, n'(J_2 - J_1) v+ >= -gain B. The change of speed counts alike for all joints,
in every shape of stop, so that the row is along the pair's own normal. With a lever for each joint its direction would
change from tick to tick as the shape does.

Closer than the buffer the row asks for opening, as fast as a part of the acceleration limits gives. Pairs that may
touch have a distance below zero. Before and in contact they have a zone where B is used up no faster than a speed of
their own. The rows give comfort only: they are soft, so that the QP always has a solution; safety is the certificate's.

**The gain may change between any two ticks.** The certificate reads no row and no gain. It reads distances, and a
distance that is only a lower bound proves less, never more. The part that is taken of a solution is therefore proven
whatever the gain is.
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
    """When of the stop a row looks at its pair."""

    along: bool  # the pair is measured at the stop's start, and the row follows the tangent to the end
    h: float  # length of the step that the row is for [s]
    lever: float  # what the next speeds add to the way until the moment [s]
    least: float  # B: what the pair has free where it is nearest on the stop [m]
    ahead: float  # how far in time the row looks: half of the stop, which is as far as it leads, and 1 / gain [s]


_SHARE = 0.25
# Ends of near-parallel capsules get rows of their own, unless the closest point is practically there already.
_SAME_POINT = 0.005  # [m]
# An instant of the stop that may soon be the nearest has a row already, so that nothing switches from tick to tick.
_SAME_DISTANCE = 0.002  # [m]
# A stop that takes a pair's points off the tangent by less than this is looked at from its start, along the tangent.
_STRAIGHT = 1e-5  # [m]
# How fast the rest of the stop may lose what it has free more than where the pair is nearest [1/s].
_CATCH_UP = 50.0


@kernel
def write_separation_rows(model: SafetyModel, data: SafetyData, h: float) -> None:
    """Rows of the pairs that can bind in a step of ``h`` [s] from the measured reference, of unit norm.

    Uses the candidate and its rollout for the certified stop from here.
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
            lever = max(s, 0.5 * h) + 0.5 * h  # at rest a faster step lengthens the stop by as much as the step itself
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
    """Write how far pair ``p`` is apart at the instants, infinite where none is looked at; returns the least [m].

    On a straight way it is nearest at one of both ends. One that is too close has to open from where it is.
    """
    ahead, last = data.rows.ahead, len(INSTANTS) - 1
    ahead[:] = np.inf
    ahead[0] = measure(model.collision, data.collision, p)
    if ahead[0] < model.min_distance[p]:
        return ahead[0]
    if straight:
        row = data.rows.matrix[-1]  # scratch: so many rows are never in use
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
    """By how much the certified stop opens a pair with the given ``row`` along the tangent [m]."""
    v, change = data.state.v, 0.0
    for j in range(row.shape[0]):
        change += row[j] * 0.5 * v[j] * abs(v[j]) / data.certified[j]
    return change


@kernel
def _append_row(
    model: SafetyModel, data: SafetyData, at: CollisionData, p: int, distance: float, moment: StopTime, count: int
) -> int:
    """Keep the row if some velocity that the acceleration allows (v +- a h) breaks it; any other cannot bind.

    Pair ``p`` has been measured in ``at``, the posture at the ``moment``, or at the start of a straight stop whose end
    the row looks at along the tangent. It gets unit norm, so that what it lacks is a joint speed.
    """
    h = moment.h
    a, v, row, lever = model.limits.acceleration, data.state.v, data.rows.matrix[count], moment.lever
    distance_row(model.collision, at, p, row)
    free = distance - model.approach.stop_distance[p]
    if moment.along:
        free += _tangent(data, row)
    rate = dot(row, v)  # of the distance [m/s]: with v kept up, B changes by as much in a second
    change = 0.0  # how much the acceleration can do about that in this step [m]
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
        # Asked for more than the joints can do in this step, rows of several pairs would be weighed against each other.
        # The deeper pair would be opened at the cost of closing another one.
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
    """Rows at those ends of both bodies of a pair that may soon be as close as its ``distance``, measured in ``at``.

    The closest points of near-parallel bodies jump from end to end; rows at the ends leave nothing to jump. An end that
    is farther by more than the bodies turn it towards each other while the row looks ahead does not take part.
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
