"""Compute how far arms keep away from obstacles that move on their own (compiled).

**Reach.** reach(s) bounds how far any point of an obstacle moves in the s seconds after a report. The point starts with
its speed at the report. It gains speed no faster than the obstacle's acceleration, up to the obstacle's greatest speed.

**Claim.** Let a step of h and a stop after it be proven to keep the distance

    c + reach(max(A + h, R) + T),    T = max(T_0, max |v_j| / a_j - h),

from the obstacle at its reported pose, as if the obstacle were fixed. A is the age of the report, and R the age of a
usual report. The velocity of each joint j is limited to a_j T_0. If the obstacle keeps its bounds, the arm's body keeps
the distance c from the moving obstacle until the body rests, whatever is reported later.

*Proof.* A stop of any shape takes max |v+_j| / a_j (stop_rollout.py). The velocity box keeps |v+_j| at or below a_j
T_0, or lets joint j only brake fully. The known stop, towards which a solution may be moved, takes no longer. The stop
therefore takes at most T. Until its end the obstacle is within reach(A + h + T) of the reported pose. []

T_0 falls as an obstacle comes nearer, but no faster than the joints can brake, so that the velocity box is never empty.
The joints slow down early, and then need less distance. The obstacle's reach may take half of the free distance; the
other half is left for the motion of the arms.

If an obstacle has come too close, the arms may still move away from its reported pose. An old report does not tell
whether this motion leads to the obstacle. T_0 then falls to 0 with the free distance, and the arms rest until the next
report.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import measure
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.kernel_pointers import KernelPointer, pointee
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.types import Array

# The age R of a usual report [s]. A newer report counts as this old, so that the kept distance does not jump if reports
# come more often.
REPORT_AGE = 0.1
# Least value of the time T_0 of a stop, while all reports are new [s]. T_0 has this value if arms are close to an
# obstacle.
_LEAST_STOP = 0.05
_LOST = 0.5  # If a report is older than this, it does not tell which motion leads away from the obstacle [s].
_SHARE = 0.5  # Share of the free distance to an obstacle that the obstacle's reach may take.
# If a pair with an obstacle is too close, its row asks for an increase of the distance by at most this [m]. The row
# does not push the arms, but they can still move away.
_OPENING = 1e-4


class ObstacleData(NamedTuple):
    """Data of the o moving obstacles, and of their n pairs, which come last among all pairs."""

    first: IntArray  # (o + 1,) Index of each obstacle's first pair among the n pairs; the last entry is n.
    speed: Array  # (o,) Greatest speed of any point [m/s].
    slower: Array  # (o,) At the report, all points were slower than ``speed`` by at least this [m/s].
    rise: Array  # (o,) Least time in which points reach ``speed``; above 0 [s].
    age: Array  # (o,) Age of the report [s].
    kept: Array  # (n,) Distance that each pair keeps [m]; minus infinity if the pair does not count now.
    buffer: Array  # (n,) The QP stops the pair at the kept distance plus this [m].
    velocity: Array  # (nv,) Velocity limits without an obstacle nearby [rad/s].
    stop_time: Array  # (1,) The time T_0 of a stop, see the module's docstring [s].


@kernel
def reach(obstacles: ObstacleData, o: int, t: float) -> float:
    """Return a bound on how far a point of obstacle ``o`` has moved ``t`` [s] after the report [m]."""
    rising = min(t, obstacles.rise[o])
    lost = obstacles.slower[o] * (rising - 0.5 * rising * rising / obstacles.rise[o])
    return obstacles.speed[o] * t - lost


@kernel
def keep_clear(
    model_pointer: KernelPointer, data_pointer: KernelPointer, obstacles_pointer: KernelPointer, h: float
) -> None:
    """Write the distances that pairs with obstacles keep, and the velocity limits, for a step of ``h`` [s]."""
    model, data, obstacles = pointee(model_pointer).safety, pointee(data_pointer).safety, pointee(obstacles_pointer)
    a, v = model.limits.acceleration, data.state.v
    longest, moving, wanted, least_stop = 0.0, 0.0, np.inf, _LEAST_STOP
    for j in range(v.shape[0]):
        longest = max(longest, obstacles.velocity[j] / a[j])
        moving = max(moving, abs(v[j]) / a[j])
    for o in range(obstacles.age.shape[0]):
        obstacles.age[o] += h
        age = obstacles.age[o]
        for p in range(obstacles.first[o], obstacles.first[o + 1]):
            lost = _SHARE * (least_stop + age) - age if age > _LOST else -np.inf
            if _stop_time(data, obstacles, o, p) < min(max(wanted, lost), longest):
                _measure(model, data, obstacles, p)  # Here the exact distance is needed, not a lower bound.
                stop_time = _stop_time(data, obstacles, o, p)
                wanted = min(wanted, stop_time)
                if age > _LOST:  # Until this time, the obstacle cannot have used up the free distance.
                    least_stop = min(least_stop, max((stop_time + age) / _SHARE - age, 0.0))
    known = obstacles.stop_time[0]
    time = min(max(wanted, least_stop, known - h), known + h, longest)
    obstacles.stop_time[0] = time
    for j in range(v.shape[0]):
        model.limits.velocity[j] = min(obstacles.velocity[j], a[j] * time)
    time = max(time, moving - h)
    for o in range(obstacles.age.shape[0]):
        way = reach(obstacles, o, max(obstacles.age[o], REPORT_AGE) + time)
        for p in range(obstacles.first[o], obstacles.first[o + 1]):
            pair, least = _pair(data, obstacles, p), obstacles.kept[p] + way
            if data.distance[pair] < least:
                _measure(model, data, obstacles, p)
            model.min_distance[pair] = least
            model.approach.stop_distance[pair] = min(least + obstacles.buffer[p], data.distance[pair] + _OPENING)


@kernel
def keep_while_stopping(
    model_pointer: KernelPointer, data_pointer: KernelPointer, obstacles_pointer: KernelPointer
) -> None:
    """Write the distances that pairs with obstacles keep during the known stop. Call it before pairs are measured."""
    model, data, obstacles = pointee(model_pointer).safety, pointee(data_pointer).safety, pointee(obstacles_pointer)
    time = 0.0
    for j in range(data.certified.shape[0]):
        time = max(time, abs(data.state.v[j]) / data.certified[j])
    for o in range(obstacles.age.shape[0]):
        way = reach(obstacles, o, obstacles.age[o] + time)
        for p in range(obstacles.first[o], obstacles.first[o + 1]):
            pair = _pair(data, obstacles, p)
            model.min_distance[pair] = obstacles.kept[p] + way
            model.approach.stop_distance[pair] = obstacles.kept[p] + way


@inlined_kernel
def _pair(data: SafetyData, obstacles: ObstacleData, p: int) -> int:
    """Return the index of the obstacles' pair ``p`` among all pairs."""
    return data.distance.shape[0] - obstacles.kept.shape[0] + p


@inlined_kernel
def _measure(model: SafetyModel, data: SafetyData, obstacles: ObstacleData, p: int) -> None:
    pair = _pair(data, obstacles, p)
    data.distance[pair] = measure(model.collision, data.collision, pair)


@inlined_kernel
def _stop_time(data: SafetyData, obstacles: ObstacleData, o: int, p: int) -> float:
    """Return the largest T_0 with which the reach of obstacle ``o`` takes only its share of the free distance [s].

    The free distance of the obstacles' pair ``p`` is used. T_0 is infinite if this pair does not count now, or if the
    obstacle does not move.
    """
    if obstacles.kept[p] == -np.inf or obstacles.speed[o] == 0.0:
        return np.inf
    room = data.distance[_pair(data, obstacles, p)] - obstacles.kept[p] - obstacles.buffer[p]
    return _SHARE * room / obstacles.speed[o] - max(obstacles.age[o], REPORT_AGE)
