"""Which arm gives way where two arms are in each other's way, compiled.

Arms meet in the QP only where separation rows couple their joints. There the costs decide: all costs of an arm that
gives way are multiplied by a small weight, so that a row that both arms need is paid for by its motion. Where no row
is active nothing changes, since the least of a sum of independent costs does not depend on their weights; that is why
posture and damping are scaled along with the tool's task.

An arm without a target holds its joints, and holding is never given up: it does not give way.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.tasks.task_data import Targets
from q2r2_control.control.tasks.task_model import Proximity, TaskModel
from q2r2_control.types import Array


@lean_kernel
def tool_speed(model: TaskModel, targets: Targets, distance: Array, i: int) -> float:
    """Speed allowed to arm ``i``'s tool [m/s] by round bodies near the arm: see :func:`speed_near`.

    ``distance`` (p,) of the pairs [m].
    """
    proximity, priority, full_speed = model.proximity, model.priority, model.motion.full_speed[0]
    nearest = np.inf
    if priority.pushes[i] == 0:
        for p in range(distance.shape[0]):
            if proximity.pair_arm[p, i] == 1.0 and distance[p] < nearest:
                nearest = distance[p]
        return speed_near(proximity, nearest, proximity.contact_speed, full_speed)
    nearest_yielding = np.inf
    for p in range(distance.shape[0]):
        if proximity.pair_arm[p, i] != 1.0:
            continue
        if _gives_way(proximity, targets, p, i):
            nearest_yielding = min(nearest_yielding, distance[p])
        else:
            nearest = min(nearest, distance[p])
    pushing = max(priority.yield_speed, proximity.contact_speed)
    return min(
        speed_near(proximity, nearest, proximity.contact_speed, full_speed),
        speed_near(proximity, nearest_yielding, pushing, full_speed),
    )


@lean_kernel
def speed_near(proximity: Proximity, nearest: float, contact_speed: float, full_speed: float) -> float:
    """Tool speed allowed with two round bodies ``nearest`` apart [m]: contact speed if closest, full from ``full_at``.

    Round bodies that slide past each other turn the normal; the acceleration this takes grows with the square of the
    sliding speed, so it has to fall before the joints, shared between rows, run out of it.
    """
    share = clamp((nearest - proximity.stop_distance) / proximity.full_at, 0.0, 1.0)
    return contact_speed + share * max(full_speed - contact_speed, 0.0)


@lean_kernel
def _gives_way(proximity: Proximity, targets: Targets, p: int, i: int) -> bool:
    """Whether the other body of pair ``p`` is one of another arm that follows a target."""
    yields = False
    for other in range(proximity.pair_arm.shape[1]):
        yields |= other != i and proximity.pair_arm[p, other] == 1.0 and targets.follows[other] == 1
    return yields
