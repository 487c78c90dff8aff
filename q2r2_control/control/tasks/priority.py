"""Which arm gives way where two arms are in each other's way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.config.control import EQUAL, ControllerSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class Priority(NamedTuple):
    """Which arm gives way where two arms are in each other's way.

    Arms meet in the QP only where separation rows couple their joints. There the costs decide: all costs of an arm that
    gives way are multiplied by a small weight, so that a row that both arms need is paid for by its motion. Where no
    row is active nothing changes, since the least of a sum of independent costs does not depend on their weights; that
    is why posture and damping are scaled along with the tool's task.

    An arm without a target holds its joints, and holding is never given up: it does not give way. The weights may
    change between ticks.
    """

    weight: Array  # (n,) of an arm's costs while it follows a target: 1, less if it gives way
    posture_weight: Array  # (nv,) the same for each joint, times the posture's own weight


def priority_of(robot: Robot, settings: ControllerSettings) -> Priority:
    """The weights of the arms' costs; ``settings.priority`` names an arm, or none."""
    n, nv = len(robot.arms), robot.model.nv
    priority = Priority(np.ones(n), np.full(nv, settings.posture_weight))
    if settings.priority == EQUAL:
        return priority
    first = robot.arms[settings.priority].joints
    for i, (name, arm) in enumerate(robot.arms.items()):
        if name == settings.priority:
            continue
        priority.weight[i] = settings.yield_weight
        # A joint that also moves the arm with priority keeps its full cost.
        priority.posture_weight[np.setdiff1d(arm.joints, first)] = settings.yield_weight * settings.posture_weight
    return priority
