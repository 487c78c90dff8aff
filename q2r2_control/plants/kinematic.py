"""A plant that follows every command exactly, for tests, replays and computers without a simulator."""

from __future__ import annotations

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.plants.base import GripperMotion, check_command, check_duration, check_joints
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState


class KinematicPlant:
    """Follows position and velocity commands without error. Grippers move at their configured speed."""

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION, CommandMode.VELOCITY)
    simulated = True

    def __init__(self, robot: Robot, config: Config) -> None:
        self._robot = robot
        self._grippers = GripperMotion(config)
        self.reset()

    @classmethod
    def from_config(cls, robot: Robot, config: Config) -> KinematicPlant:
        return cls(robot, config)

    def reset(self, q: Array | None = None) -> None:
        posture = self._robot.home if q is None else q
        check_joints("reset q", posture, self._robot)
        self._q = np.array(posture, dtype=np.float64)
        self._v = np.zeros_like(self._q)
        self._due_q: Array | None = self._q  # The commanded posture; None if a velocity was commanded.
        self._due_v = self._v
        self._time = 0.0
        self._grippers.reset()

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        self._due_q = None if command.mode is CommandMode.VELOCITY else command.q.copy()
        self._due_v = command.v.copy()
        self._grippers.command(command.grippers)

    def advance(self, dt: float) -> None:
        check_duration(dt)
        if dt == 0:
            return
        self._q = self._q + dt * self._due_v if self._due_q is None else self._due_q
        self._due_q, self._v, self._due_v = self._q, self._due_v, np.zeros(len(self._q))
        self._time += dt
        self._grippers.advance(dt)

    def state(self) -> RobotState:
        """See :meth:`Plant.state`. Torques are zero, and external torques are not known."""
        return RobotState(self._q.copy(), self._v.copy(), np.zeros(len(self._q)), None, self._time)

    def gripper_openings(self) -> dict[str, float]:
        return dict(self._grippers.openings)

    def close(self) -> None:
        """See :meth:`Plant.close`."""
