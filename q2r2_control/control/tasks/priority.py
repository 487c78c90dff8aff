"""Decide which arm gives way if one arm blocks the other, by weights of the arms' costs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.config.control import EQUAL, ControllerSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class Priority(NamedTuple):
    """Weights that decide which arm gives way if one arm blocks the other. The weights may change between ticks.

    In the QP the arms influence each other only through separation rows, which couple their joints. All costs of an arm
    that gives way, including the costs of posture and damping, are multiplied by a small weight. If a row couples both
    arms, the QP then changes the motion of the arm that gives way, and not the motion of the other arm. If no row is
    active, the weights change nothing. An arm without a target holds its joints, and does not give way.
    """

    arm: Array  # (n,) Weight of an arm's costs while it follows a target: 1, or less if it gives way.
    joint: Array  # (nv,) The weight of each joint.


def priority_of(robot: Robot, settings: ControllerSettings) -> Priority:
    """Return the weights of the arms' costs. ``settings.priority`` names the arm that does not give way, or no arm."""
    priority = Priority(np.ones(len(robot.arms)), np.ones(robot.model.nv))
    if settings.priority == EQUAL:
        return priority
    first = robot.arms[settings.priority].joints
    for i, (name, arm) in enumerate(robot.arms.items()):
        if name == settings.priority:
            continue
        priority.arm[i] = settings.yield_weight
        # A joint that also moves the arm with priority keeps its full cost.
        priority.joint[np.setdiff1d(arm.joints, first)] = settings.yield_weight
    return priority
