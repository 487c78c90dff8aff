"""Write the cost that moves the joints towards a posture, as far as the tools leave the joints free.

The cost of all joints is w |v - v_p|^2. The posture velocity v_p is projected into the nullspace of the tools, so that
it causes no error of a tool at rest. Joints of an arm without a target have v_p = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.geometry.closest_points import clamp, dot
from q2r2_control.control.jit import kernel
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.control.targets import TaskTargets
    from q2r2_control.control.tasks.built_in import TaskData, TaskModel

_PROJECTION_DAMPING = 1e-3


class Posture(NamedTuple):
    """How joints move to the posture as far as the tools leave them free. Gain and weight may change between ticks."""

    home: Array  # (nv,) [rad]
    gain: Array  # (1,) [1/s]
    weight: Array  # (1,) Weight, compared with 1 for the task of a tool.
    speed: float  # Largest speed [rad/s].


def posture_of(robot: Robot, settings: ControllerSettings) -> Posture:
    """Return the home posture, and the gain, weight and speed of the motion towards a posture."""
    gain, weight = np.array([settings.posture_gain]), np.array([settings.posture_weight])
    return Posture(np.array(robot.home), gain, weight, settings.posture_speed)


class PostureData(NamedTuple):
    """Data that are written at each tick."""

    v: Array  # (nv,) The posture velocity v_p [rad/s].
    factor: Array  # (6 n, 6 n) Cholesky factor of the damped J J'.
    moved: Array  # (6 n,) Buffer for J v and for the solution of J J' x = J v.

    @classmethod
    def empty(cls, n: int, nv: int) -> PostureData:
        return cls(np.zeros(nv), np.zeros((6 * n, 6 * n)), np.zeros(6 * n))


@kernel
def accumulate_posture_cost(model: TaskModel, data: TaskData, targets: TaskTargets, q: Array) -> None:
    """Add the cost w |v - v_p|^2 of all joints. The Jacobians of the tools have to be written before this call."""
    gain, speed, v = model.posture.gain[0], model.posture.speed, data.posture.v
    for j in range(q.shape[0]):
        v[j] = clamp(gain * (targets.posture[j] - q[j]), -speed, speed)
    for i in range(targets.follows.shape[0]):
        if targets.follows[i] == 0:
            for j in range(q.shape[0]):
                if targets.member[i, j] == 1.0:
                    v[j] = 0.0
    project_to_nullspace(data.J, data.posture.factor, data.posture.moved, v)
    for j in range(q.shape[0]):
        weight = model.posture.weight[0] * model.priority.joint[j]
        data.H[j, j] += weight
        data.g[j] -= weight * v[j]


@kernel
def project_to_nullspace(J: Array, factor: Array, moved: Array, v: Array) -> None:
    """Remove from ``v`` (nv,) the part that moves the tools with Jacobians J (6n, nv): v -= J' (J J' + d I)^-1 J v.

    ``factor`` (6n, 6n) and ``moved`` (6n,) are buffers.
    """
    for i in range(J.shape[0]):
        for j in range(i, J.shape[0]):
            factor[i, j] = dot(J[i], J[j])
        factor[i, i] += _PROJECTION_DAMPING * _PROJECTION_DAMPING
        moved[i] = dot(J[i], v)
    factorise(factor)  # The matrix is positive definite for any finite J. If J is not finite, v becomes not finite too.
    substitute(factor, moved)
    for j in range(J.shape[1]):
        for i in range(J.shape[0]):
            v[j] -= J[i, j] * moved[i]
