"""How far arms keep away from obstacles that move on their own, compiled.

**Reach.** No point of an obstacle is farther than reach(s) from where it was s seconds before. Its points gain speed no
faster than its acceleration, from the speed at that time on, up to its greatest speed.

**Claim.** Let a step of h and a stop after it be proven to keep the distance

    c + reach(max(A + h, R) + T),    T = max(T_0, max |v_j| / a_j - h),

from the pose that is reported, of age A, as from a fixed body. R is the age of a usual report, and the velocities of
the joints are limited to a_j T_0. If the obstacle keeps its bounds, the body keeps c from the obstacle itself until it
rests, whatever is reported later.

*Proof.* The stop takes max |v+_j| / a_j in every shape (stop_rollout.py). The box holds |v+_j| at or below a_j T_0, or
brakes fully. The stop at hand, towards which a solution may be moved, takes no longer. The stop therefore takes at most
T. Until its end the obstacle is within reach(A + h + T) of the pose. []

T_0 falls where an obstacle comes nearer, no faster than joints brake: the velocity box is never empty. Joints slow down
early and need less distance. Half of the room to the obstacle is left for the arms' own way.
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

REPORT_AGE = 0.1  # R: reports that come more often change nothing when they come [s]
_LEAST_STOP = 0.05  # T_0 of arms close to an obstacle [s]
_SHARE = 0.5  # of the room to an obstacle that its reach may take
# A row asks a pair that is too close to open by no more than this: arms are not pushed, and can be proven to leave.
_OPENING = 1e-4  # [m]


class ObstacleData(NamedTuple):
    """Moving obstacles o, and their pairs, which are the last n of all."""

    first: IntArray  # (o + 1,) the first pair of each among the n, and n
    speed: Array  # (o,) the greatest of any point [m/s]
    slower: Array  # (o,) by how much all points were slower when reported [m/s]
    rise: Array  # (o,) time that they need at least to make up for that, more than 0 [s]
    age: Array  # (o,) of the report [s]
    kept: Array  # (n,) distance of each pair [m]; minus infinity: it does not count now
    buffer: Array  # (n,) how much farther away the QP stops [m]
    velocity: Array  # (nv,) limits where no obstacle is near [rad/s]
    stop_time: Array  # (1,) T_0 [s]


@kernel
def reach(obstacles: ObstacleData, o: int, t: float) -> float:
    """How far a point of obstacle ``o`` is at most from where it was, ``t`` [s] after its report [m]."""
    rising = min(t, obstacles.rise[o])
    lost = obstacles.slower[o] * (rising - 0.5 * rising * rising / obstacles.rise[o])
    return obstacles.speed[o] * t - lost


@kernel
def keep_clear(
    model_pointer: KernelPointer, data_pointer: KernelPointer, obstacles_pointer: KernelPointer, h: float
) -> None:
    """Write what pairs with obstacles have to keep, and velocity limits, for a step of ``h`` from an observed state."""
    model, data, obstacles = pointee(model_pointer).safety, pointee(data_pointer).safety, pointee(obstacles_pointer)
    a, v = model.limits.acceleration, data.state.v
    longest, moving, wanted = 0.0, 0.0, np.inf
    for j in range(v.shape[0]):
        longest = max(longest, obstacles.velocity[j] / a[j])
        moving = max(moving, abs(v[j]) / a[j])
    for o in range(obstacles.age.shape[0]):
        obstacles.age[o] += h
        for p in range(obstacles.first[o], obstacles.first[o + 1]):
            if _stop_time(data, obstacles, o, p) < min(wanted, longest):
                _measure(model, data, obstacles, p)  # a lower bound of the distance will not do
                wanted = min(wanted, _stop_time(data, obstacles, o, p))
    known = obstacles.stop_time[0]
    time = min(max(wanted, _LEAST_STOP, known - h), known + h, longest)
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
    """Write what pairs with obstacles have to keep in the stop at hand, before they are observed."""
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
    """The number among all pairs of the one that is ``p`` among those of obstacles."""
    return data.distance.shape[0] - obstacles.kept.shape[0] + p


@inlined_kernel
def _measure(model: SafetyModel, data: SafetyData, obstacles: ObstacleData, p: int) -> None:
    pair = _pair(data, obstacles, p)
    data.distance[pair] = measure(model.collision, data.collision, pair)


@inlined_kernel
def _stop_time(data: SafetyData, obstacles: ObstacleData, o: int, p: int) -> float:
    """T_0 for which a pair leaves room [s]; infinite for one that does not count and an obstacle that stays."""
    if obstacles.kept[p] == -np.inf or obstacles.speed[o] == 0.0:
        return np.inf
    room = data.distance[_pair(data, obstacles, p)] - obstacles.kept[p] - obstacles.buffer[p]
    return _SHARE * room / obstacles.speed[o] - max(obstacles.age[o], REPORT_AGE)
