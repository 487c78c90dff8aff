"""What the task kernels know of a robot and its settings: the models of all tasks."""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.kinematics import Chain
from q2r2_control.control.tasks.frame import Motion, motion_of
from q2r2_control.control.tasks.posture import Posture, posture_of
from q2r2_control.control.tasks.priority import Priority, priority_of
from q2r2_control.control.tasks.tools import Tools, tools_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class TaskModel(NamedTuple):
    """What does not change in a tick, and between ticks but for gains and weights."""

    chain: Chain
    tools: Tools
    motion: Motion
    posture: Posture
    priority: Priority

    @property
    def live(self) -> tuple[Array, ...]:
        """Gains, speeds and weights, which may change between ticks: whatever is held, kernels read these arrays."""
        return (*self.motion, self.posture.gain, *self.priority)


def task_model_of(robot: Robot, settings: ControllerSettings, chain: Chain) -> TaskModel:
    """The models of all tasks."""
    return TaskModel(
        chain=chain,
        tools=tools_of(robot),
        motion=motion_of(settings),
        posture=posture_of(robot, settings),
        priority=priority_of(robot, settings),
    )
