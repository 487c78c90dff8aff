"""Rows of the QP that keep monitored pairs apart, and what the pairs' distances are.

For free distance x = d - min_distance - buffer a pair may close in with at most

    c(x) = min(gain x, sqrt(2 alpha x)),    alpha = share * sum_j |dd/dq_j| a_j,

the second being the speed that the deceleration alpha stops within x, alpha the part of what the acceleration limits
leave along that row, since joints are shared between rows. Closer than the buffer the row asks for opening instead.
The rows give comfort only: they are soft, so that the QP always has a solution; safety is the certificate's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp, segment_segment
from q2r2_control.control.geometry.collision import Bodies, Contact, Pairs, Posed, at_least, distance_row, measure
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.velocity_bounds import Pace, fastest_approach
from q2r2_control.types import Array

_SHARE = 0.25
# Ends of near-parallel capsules get rows of their own, unless the closest point is practically there already.
_SAME_POINT = 0.005  # [m]


class Approach(NamedTuple):
    """How pairs may approach each other."""

    stop_distance: float  # min_distance + buffer [m]
    gain: float  # [1/s]
    recovery_speed: float  # [m/s]
    slow_below: float  # distance at which round pairs begin to slow the arms down [m]


class Rows(NamedTuple):
    """Rows ``matrix v >= lower`` written by :func:`separation_rows`; the first ``used[0]`` are valid."""

    matrix: Array  # (m, nv)
    lower: Array  # (m,) [m/s]
    pair: IntArray  # (m,)
    used: IntArray  # (1,) number of valid rows

    @classmethod
    def empty(cls, pairs: int, nv: int) -> Rows:
        capacity = 5 * pairs  # the closest points and four segment ends
        return cls(
            np.zeros((capacity, nv)),
            np.zeros(capacity),
            np.zeros(capacity, dtype=np.int64),
            np.zeros(1, dtype=np.int64),
        )


@lean_kernel
def slowest_rate(free: float, alpha: float, approach: Approach) -> float:
    """Least rate of distance [m/s] allowed at the free distance ``free`` [m]."""
    if free < 0.0:
        return min(-approach.gain * free, approach.recovery_speed)
    return -min(approach.gain * free, np.sqrt(2.0 * alpha * free))


@lean_kernel
def _append_row(
    chain: Chain,
    placements: Placements,
    pairs: Pairs,
    p: int,
    contact: Contact,
    distance: float,
    v: Array,
    a: Array,
    h: float,
    approach: Approach,
    rows: Rows,
    count: int,
) -> int:
    """Keep the row if some velocity that the acceleration allows (v +- a h) breaks it; any other cannot bind."""
    row = rows.matrix[count]
    distance_row(chain, placements, pairs, p, contact, row)
    rate = 0.0
    change = 0.0
    for j in range(row.shape[0]):
        rate += row[j] * v[j]
        change += abs(row[j]) * a[j] * h
    lower = slowest_rate(distance - approach.stop_distance, _SHARE * change / h, approach)
    if lower > 0.0:
        # Asked for more than the joints can do in this step, rows of several pairs would be weighed against each other,
        # and the deeper pair would be opened at the cost of closing another one.
        lower = min(lower, max(rate, 0.0) + _SHARE * change)
    if rate - change >= lower or change <= 0.0:
        return count
    rows.lower[count] = lower
    rows.pair[count] = p
    return count + 1


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


@lean_kernel
def separation_rows(
    chain: Chain,
    placements: Placements,
    bodies: Bodies,
    posed: Posed,
    pairs: Pairs,
    pace: Pace,
    v: Array,
    a: Array,
    h: float,
    approach: Approach,
    distance: Array,
    contact: Contact,
    rows: Rows,
) -> int:
    """Measure every pair and append the rows that can bind in this step.

    ``distance`` (p,) receives the exact distance where it matters (a row could bind, the arms could have to slow down,
    the closest pair) and a lower bound elsewhere. Returns the closest pair.
    """
    count = 0
    closest = 0
    least = np.inf
    witness = contact.witness
    surge = 0.0
    for j in range(a.shape[0]):
        surge = max(surge, a[j] * h)
    for p in range(pairs.first.shape[0]):
        first = pairs.first[p]
        second = pairs.second[p]
        distance[p] = at_least(bodies, posed, first, second)
        # The fastest that the pair can close in after this step. Farther than twice what the gain needs for that, a row
        # could bind only through its root, at very low leverage: it would add comfort, and the certificate needs none.
        closing = fastest_approach(pace, first, second) + pairs.leverage[p] * surge
        relevant = approach.stop_distance + 2.0 * closing / approach.gain
        if pairs.round[p] == 1:
            relevant = max(relevant, approach.slow_below)
        if distance[p] > relevant and distance[p] >= least:
            continue
        start = posed.start[first]
        end = posed.end[first]
        distance[p] = measure(bodies, posed, first, second, start, end, contact)
        if distance[p] < least:
            least = distance[p]
            closest = p
        if distance[p] > relevant:
            continue
        before = count
        count = _append_row(chain, placements, pairs, p, contact, distance[p], v, a, h, approach, rows, count)
        if count == before:
            continue
        # The closest points of near-parallel bodies jump from end to end; rows at all ends leave nothing to jump.
        _copy(contact.first, witness)
        for point in (start, end):
            if not _near(point, witness):
                reached = measure(bodies, posed, first, second, point, point, contact)
                count = _append_row(chain, placements, pairs, p, contact, reached, v, a, h, approach, rows, count)
        if bodies.box[second] == 1:
            continue
        measure(bodies, posed, first, second, start, end, contact)
        _copy(contact.second, witness)
        for point in (posed.start[second], posed.end[second]):
            if not _near(point, witness):
                reached = segment_segment(start, end, point, point, contact.first, contact.second)
                if reached > 1e-9:
                    for k in range(3):
                        contact.normal[k] = (contact.second[k] - contact.first[k]) / reached
                    reached -= bodies.radius[first] + bodies.radius[second]
                    count = _append_row(chain, placements, pairs, p, contact, reached, v, a, h, approach, rows, count)
    rows.used[0] = count
    return closest


@lean_kernel
def speed_near(nearest: float, stop_distance: float, contact_speed: float, full_speed: float, full_at: float) -> float:
    """Tool speed allowed with two round bodies ``nearest`` apart [m]: contact speed if closest, full from ``full_at``.

    Round bodies that slide past each other turn the normal; the acceleration this takes grows with the square of the
    sliding speed, so it has to fall before the joints, shared between rows, run out of it.
    """
    share = clamp((nearest - stop_distance) / full_at, 0.0, 1.0)
    return contact_speed + share * max(full_speed - contact_speed, 0.0)
