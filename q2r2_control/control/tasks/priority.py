"""Which arm gives way where two arms are in each other's way, compiled.

Arms meet in the QP only where separation rows couple their joints. There the costs decide: all costs of an arm that
gives way are multiplied by a small weight, so that a row that both arms need is paid for by its motion. Where no row
is active nothing changes, since the least of a sum of independent costs does not depend on their weights; that is why
posture and damping are scaled along with the tool's task.

An arm without a target holds its joints, and holding is never given up: it does not give way.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.separation_rows import speed_near
from q2r2_control.types import Array


class Priority(NamedTuple):
    """What the arms' costs weigh, and how fast the arm with priority may push."""

    weight: Array  # (n,) of an arm's costs while it follows a target: 1, less if it gives way
    posture_weight: Array  # (nv,) the same for each joint, times the posture's own weight
    pushes: IntArray  # (n,) 1 for the arm with priority
    yield_speed: float  # its tool's speed where another arm, which gives way, is closest [m/s]


@lean_kernel
def tool_speed(
    i: int,
    distance: Array,
    pair_arm: Array,
    follows: IntArray,
    priority: Priority,
    stop_distance: float,
    contact_speed: float,
    full_speed: float,
    full_at: float,
) -> float:
    """Speed allowed to arm ``i``'s tool [m/s] by round bodies near the arm: see :func:`speed_near`.

    ``distance`` (p,) [m]; ``pair_arm`` (p, n) says which pairs slow which arms; ``follows`` (n,) which arms have a
    target.
    """
    nearest = np.inf
    if priority.pushes[i] == 0:
        for p in range(distance.shape[0]):
            if pair_arm[p, i] == 1.0 and distance[p] < nearest:
                nearest = distance[p]
        return speed_near(nearest, stop_distance, contact_speed, full_speed, full_at)
    nearest_yielding = np.inf
    for p in range(distance.shape[0]):
        if pair_arm[p, i] != 1.0:
            continue
        if _gives_way(pair_arm, p, i, follows):
            nearest_yielding = min(nearest_yielding, distance[p])
        else:
            nearest = min(nearest, distance[p])
    return min(
        speed_near(nearest, stop_distance, contact_speed, full_speed, full_at),
        speed_near(nearest_yielding, stop_distance, max(priority.yield_speed, contact_speed), full_speed, full_at),
    )


@lean_kernel
def _gives_way(pair_arm: Array, p: int, i: int, follows: IntArray) -> bool:
    """Whether the other body of pair ``p`` is one of another arm that follows a target."""
    yields = False
    for other in range(pair_arm.shape[1]):
        yields |= other != i and pair_arm[p, other] == 1.0 and follows[other] == 1
    return yields
