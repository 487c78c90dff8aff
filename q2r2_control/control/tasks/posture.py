"""Joints that no tool needs: a cost on their velocity, and joints of held arms that stay where they are, compiled.

For all joints w |v - v_p|^2 with the posture velocity v_p projected into the tools' nullspace, so that at rest it
leaves no tool error. An arm without a target holds its joints by a cost of their own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.jit import kernel
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

if TYPE_CHECKING:  # these are made of what this module defines
    from q2r2_control.control.tasks.task_data import TaskData, TaskModel, TaskTargets

# A held arm is not pushed about by the other one's task, but may give way to recover separation.
_HOLD_WEIGHT = 300.0
HOLD_GAIN = 4.0  # [1/s]
_PROJECTION_DAMPING = 1e-3


class Posture(NamedTuple):
    """Where joints go that the tools leave free."""

    home: Array  # (nv,) [rad]
    gain: Array  # (1,), which may change between ticks [1/s]
    speed: float  # at most [rad/s]


def posture_of(robot: Robot, settings: ControllerSettings) -> Posture:
    """Home, and how fast joints go there."""
    home = np.array(robot.home, dtype=np.float64)
    return Posture(home=home, gain=np.array([settings.posture_gain]), speed=settings.posture_speed)


@kernel
def pull_to_posture(model: TaskModel, data: TaskData, targets: TaskTargets, q: Array) -> None:
    """Velocity of every joint from ``q`` (nv,) towards the posture that is asked for, into ``data.posture``."""
    gain, speed = model.posture.gain[0], model.posture.speed
    for j in range(q.shape[0]):
        data.posture[j] = clamp(gain * (targets.posture[j] - q[j]), -speed, speed)


@kernel
def accumulate_hold_cost(data: TaskData, targets: TaskTargets, i: int, q: Array) -> None:
    """Joints of the held arm ``i`` return to where they were latched; the posture pull does not move them."""
    for j in range(q.shape[0]):
        if targets.member[i, j] == 1.0:
            data.H[j, j] += _HOLD_WEIGHT
            data.g[j] -= _HOLD_WEIGHT * HOLD_GAIN * (targets.hold[j] - q[j])
            data.posture[j] = 0.0


@kernel
def accumulate_posture_cost(model: TaskModel, data: TaskData) -> None:
    """Add the cost of all joints' distance from ``data.posture``."""
    for j in range(data.posture.shape[0]):
        weight = model.priority.posture_weight[j]
        data.H[j, j] += weight
        data.g[j] -= weight * data.posture[j]


@kernel
def factor_of_tools(J: Array, factor: Array) -> None:
    """``factor`` (6n, 6n) of J J' + d I, by Cholesky, of all tools' Jacobians J (6n, nv)."""
    for i in range(J.shape[0]):
        for j in range(i, J.shape[0]):
            total = 0.0
            for k in range(J.shape[1]):
                total += J[i, k] * J[j, k]
            factor[i, j] = total
        factor[i, i] += _PROJECTION_DAMPING * _PROJECTION_DAMPING
    factorise(factor)  # positive definite for any finite J; of another, J v is not finite either


@kernel
def project_to_nullspace(J: Array, factor: Array, moved: Array, v: Array) -> None:
    """Remove from ``v`` (nv,) what moves the tools: v -= J' (J J' + d I)^-1 J v.

    ``factor``: see :func:`factor_of_tools`; ``moved`` (6n,) is scratch.
    """
    for i in range(J.shape[0]):
        moved[i] = 0.0
        for k in range(J.shape[1]):
            moved[i] += J[i, k] * v[k]
    substitute(factor, moved)
    for j in range(J.shape[1]):
        for i in range(J.shape[0]):
            v[j] -= J[i, j] * moved[i]
