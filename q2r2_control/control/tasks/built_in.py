"""The list of the built-in tasks: for each task its model, its data, and the call that adds its cost."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.kinematics import Chain, Placements
from q2r2_control.control.jit import kernel
from q2r2_control.control.tasks.frame import FrameData, Motion, Tools, accumulate_frame_cost, motion_of, tools_of
from q2r2_control.control.tasks.hold import accumulate_hold_cost
from q2r2_control.control.tasks.posture import Posture, PostureData, accumulate_posture_cost, posture_of
from q2r2_control.control.tasks.priority import Priority, priority_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.control.targets import TaskTargets


class TaskModel(NamedTuple):
    """Data that are constant within a tick. Arrays of live settings may change between ticks (live_settings.py)."""

    chain: Chain
    tools: Tools
    motion: Motion
    posture: Posture
    priority: Priority


def task_model_of(robot: Robot, settings: ControllerSettings, chain: Chain) -> TaskModel:
    """Return the models of all tasks."""
    return TaskModel(
        chain, tools_of(robot), motion_of(settings), posture_of(robot, settings), priority_of(robot, settings)
    )


class TaskData(NamedTuple):
    """The poses of the tools at the reference, the data of all tasks, and the total cost of the tasks."""

    placements: Placements  # Placements of the joint frames at the reference.
    rotation: Array  # (n, 3, 3) Rotations of the tools.
    translation: Array  # (n, 3) Positions of the tools [m].
    J: Array  # (6 n, nv) Jacobians of the tools, one below the other; zero for an arm that follows no target.
    frame: FrameData
    posture: PostureData
    H: Array  # (nv, nv) H of the cost 1/2 v' H v + g' v.
    g: Array  # (nv,)
    minimum: Array  # (nv,) Minimum of that cost without bounds [rad/s].
    factor: Array  # (nv, nv) Cholesky factor of H.

    @classmethod
    def empty(cls, model: TaskModel, placements: Placements) -> TaskData:
        n, nv = model.tools.member.shape
        return cls(
            placements=placements,
            rotation=np.zeros((n, 3, 3)),
            translation=np.zeros((n, 3)),
            J=np.zeros((6 * n, nv)),
            frame=FrameData.empty(n),
            posture=PostureData.empty(n, nv),
            H=np.zeros((nv, nv)),
            g=np.zeros(nv),
            minimum=np.zeros(nv),
            factor=np.zeros((nv, nv)),
        )


@kernel
def write_task_cost(model: TaskModel, data: TaskData, targets: TaskTargets, q: Array) -> None:
    """Write the cost of all tasks at the reference ``q`` (nv,)."""
    data.H[:] = 0.0
    data.g[:] = 0.0
    accumulate_frame_cost(model, data, targets)
    accumulate_hold_cost(data, targets, q)
    accumulate_posture_cost(model, data, targets, q)
