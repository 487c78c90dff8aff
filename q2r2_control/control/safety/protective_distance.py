"""Compute how far arms keep away from obstacles that move on their own (compiled).

**Reach.** No point of an obstacle is farther than reach(s) from where it was s seconds before. From its speed at that
time, a point gains speed no faster than the obstacle's acceleration, up to its greatest speed.

**Claim.** Let a step of h and a stop after it be proven to keep the distance

    c + reach(max(A + h, R) + T),    T = max(T_0, max |v_j| / a_j - h),

from the reported pose, of age A, as from a fixed body. R is the age of a usual report, and the joints' velocities are
limited to a_j T_0. If the obstacle keeps its bounds, the body keeps the distance c from the obstacle itself until it
rests, whatever is reported later.

*Proof.* A stop of any shape takes max |v+_j| / a_j (stop_rollout.py). The box keeps |v+_j| at or below a_j T_0, or
brakes fully. The known stop, towards which a solution may be moved, takes no longer. The stop therefore takes at most
T. Until its end the obstacle is within reach(A + h + T) of the pose. []

T_0 falls as an obstacle comes nearer, but no faster than the joints can brake, so that the velocity box is never empty.
The joints slow down early, and then need less distance. Half of the room to the obstacle is left for the arms' own way.

Arms that an obstacle has come too near to may leave its reported place. If the report is old, this may lead to where
the obstacle is now. T_0 then falls to 0 with the room, and the arms rest until the next report.
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

REPORT_AGE = 0.1  # R. If reports come more often, the kept distance does not jump with each of them [s].
_LEAST_STOP = 0.05  # T_0 of arms close to an obstacle [s].
_LOST = 0.5  # Age from which a report does not tell any more which motion leads away from the obstacle [s].
_SHARE = 0.5  # Share of the room to an obstacle that its reach may take.
# A row asks a pair that is too close to open by this at most [m]. The arms are then not pushed, and can still leave.
_OPENING = 1e-4


class ObstacleData(NamedTuple):
    """The moving obstacles o, and their pairs, which are the last n of all pairs."""

    first: IntArray  # (o + 1,) Index of the first pair of each obstacle among the n pairs, and n.
    speed: Array  # (o,) Greatest speed of any point [m/s].
    slower: Array  # (o,) By how much all points were slower at the report [m/s].
    rise: Array  # (o,) Least time in which they reach the greatest speed, above 0 [s].
    age: Array  # (o,) Age of the report [s].
    kept: Array  # (n,) Distance that each pair keeps [m]; minus infinity if the pair does not count now.
    buffer: Array  # (n,) By how much earlier the QP stops the pair [m].
    velocity: Array  # (nv,) Velocity limits without an obstacle nearby [rad/s].
    stop_time: Array  # (1,) T_0 [s].


@kernel
def reach(obstacles: ObstacleData, o: int, t: float) -> float:
    """Return how far a point of obstacle ``o`` is at most from its place at the report, ``t`` [s] later [m]."""
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
                _measure(model, data, obstacles, p)  # A lower bound of the distance does not suffice here.
                stop_time = _stop_time(data, obstacles, o, p)
                wanted = min(wanted, stop_time)
                if age > _LOST:  # The time until the obstacle may have used up the whole room.
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
    """Write the distances that pairs with obstacles keep during the known stop, before they are measured."""
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
    """Return the number among all pairs of pair ``p`` of the obstacles."""
    return data.distance.shape[0] - obstacles.kept.shape[0] + p


@inlined_kernel
def _measure(model: SafetyModel, data: SafetyData, obstacles: ObstacleData, p: int) -> None:
    pair = _pair(data, obstacles, p)
    data.distance[pair] = measure(model.collision, data.collision, pair)


@inlined_kernel
def _stop_time(data: SafetyData, obstacles: ObstacleData, o: int, p: int) -> float:
    """Return the T_0 for which a pair leaves room [s]; infinite for a pair that does not count or does not move."""
    if obstacles.kept[p] == -np.inf or obstacles.speed[o] == 0.0:
        return np.inf
    room = data.distance[_pair(data, obstacles, p)] - obstacles.kept[p] - obstacles.buffer[p]
    return _SHARE * room / obstacles.speed[o] - max(obstacles.age[o], REPORT_AGE)
