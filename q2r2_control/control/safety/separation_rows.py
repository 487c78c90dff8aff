"""Rows of the QP that keep monitored pairs apart, and what the pairs' distances are.

For free distance x = d - min_distance - buffer a pair may close in with at most

    c(x) = min(gain x, sqrt(2 alpha x)),    alpha = share * sum_j |dd/dq_j| a_j,

the second being the speed that the deceleration alpha stops within x, alpha the part of what the acceleration limits
leave along that row, since joints are shared between rows. Closer than the buffer the row asks for opening instead.
The rows give comfort only: they are soft, so that the QP always has a solution; safety is the certificate's.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import segment_segment
from q2r2_control.control.geometry.pair_distance import at_least, distance_row, measure, measure_part
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.safety_model import Approach, SafetyModel
from q2r2_control.control.safety.velocity_bounds import fastest_approach
from q2r2_control.types import Array

_SHARE = 0.25
# Ends of near-parallel capsules get rows of their own, unless the closest point is practically there already.
_SAME_POINT = 0.005  # [m]


@lean_kernel
def slowest_rate(free: float, alpha: float, approach: Approach) -> float:
    """Least rate of distance [m/s] allowed at the free distance ``free`` [m]."""
    if free < 0.0:
        return min(-approach.gain * free, approach.recovery_speed)
    return -min(approach.gain * free, np.sqrt(2.0 * alpha * free))


@lean_kernel
def write_separation_rows(model: SafetyModel, data: SafetyData) -> int:
    """Measure every pair at the reference and write the rows that can bind in a step of the longest time.

    Needs the placements and velocities there. ``data.distance`` receives the exact distance where it matters (a row
    could bind, the arms could have to slow down, the closest pair) and a lower bound elsewhere. Returns the closest
    pair.
    """
    collision, approach, distance = model.collision, model.approach, data.distance
    pairs = collision.pairs
    count = 0
    closest = 0
    least = np.inf
    surge = 0.0
    for j in range(model.limits.acceleration.shape[0]):
        surge = max(surge, model.limits.acceleration[j] * model.limits.longest_step)
    for p in range(pairs.first.shape[0]):
        distance[p] = at_least(collision, data.collision, p)
        # The fastest that the pair can close in after this step. Farther than twice what the gain needs for that, a row
        # could bind only through its root, at very low leverage: it would add comfort, and the certificate needs none.
        closing = fastest_approach(data.velocities, pairs.first[p], pairs.second[p]) + pairs.leverage[p] * surge
        relevant = approach.stop_distance + 2.0 * closing / approach.gain
        if pairs.round[p] == 1:
            relevant = max(relevant, approach.slow_below)
        if distance[p] > relevant and distance[p] >= least:
            continue
        distance[p] = measure(collision, data.collision, p)
        if distance[p] < least:
            least = distance[p]
            closest = p
        if distance[p] > relevant:
            continue
        before = count
        count = _append_row(model, data, p, distance[p], count)
        if count > before:
            count = _append_end_rows(model, data, p, count)
    data.rows.used[0] = count
    return closest


@lean_kernel
def normalise_rows(data: SafetyData) -> None:
    """Give every row unit norm, so that what it lacks is a joint speed."""
    rows = data.rows
    for i in range(rows.used[0]):
        square = 0.0
        for j in range(rows.matrix.shape[1]):
            square += rows.matrix[i, j] ** 2
        size = np.sqrt(square)
        for j in range(rows.matrix.shape[1]):
            rows.matrix[i, j] /= size
        rows.lower[i] /= size


@lean_kernel
def _append_row(model: SafetyModel, data: SafetyData, p: int, distance: float, count: int) -> int:
    """Keep the row if some velocity that the acceleration allows (v +- a h) breaks it; any other cannot bind."""
    a, h, v = model.limits.acceleration, model.limits.longest_step, data.state.v
    row = data.rows.matrix[count]
    distance_row(model.collision, data.collision, p, row)
    rate = 0.0
    change = 0.0
    for j in range(row.shape[0]):
        rate += row[j] * v[j]
        change += abs(row[j]) * a[j] * h
    lower = slowest_rate(distance - model.approach.stop_distance, _SHARE * change / h, model.approach)
    if lower > 0.0:
        # Asked for more than the joints can do in this step, rows of several pairs would be weighed against each other,
        # and the deeper pair would be opened at the cost of closing another one.
        lower = min(lower, max(rate, 0.0) + _SHARE * change)
    if rate - change >= lower or change <= 0.0:
        return count
    data.rows.lower[count] = lower
    data.rows.pair[count] = p
    return count + 1


@lean_kernel
def _append_end_rows(model: SafetyModel, data: SafetyData, p: int, count: int) -> int:
    """Rows at the ends of both bodies of a pair that was measured just now.

    The closest points of near-parallel bodies jump from end to end; rows at all ends leave nothing to jump.
    """
    bodies, posed, contact = model.collision.bodies, data.collision.posed, data.collision.contact
    first, second = model.collision.pairs.first[p], model.collision.pairs.second[p]
    start, end, witness = posed.start[first], posed.end[first], contact.witness
    _copy(contact.first, witness)
    for point in (start, end):
        if not _near(point, witness):
            reached = measure_part(model.collision, data.collision, p, point, point)
            count = _append_row(model, data, p, reached, count)
    if bodies.box[second] == 1:
        return count
    measure(model.collision, data.collision, p)
    _copy(contact.second, witness)
    for point in (posed.start[second], posed.end[second]):
        if not _near(point, witness):
            reached = segment_segment(start, end, point, point, contact.first, contact.second)
            if reached > 1e-9:
                for k in range(3):
                    contact.normal[k] = (contact.second[k] - contact.first[k]) / reached
                reached -= bodies.radius[first] + bodies.radius[second]
                count = _append_row(model, data, p, reached, count)
    return count


@lean_kernel
def _near(point: Array, other: Array) -> bool:
    return (
        abs(point[0] - other[0]) < _SAME_POINT
        and abs(point[1] - other[1]) < _SAME_POINT
        and abs(point[2] - other[2]) < _SAME_POINT
    )


@lean_kernel
def _copy(point: Array, to: Array) -> None:
    for k in range(3):
        to[k] = point[k]
