"""Position and velocity mode: the plant's own servos follow the reference, compliance is an admittance."""

from __future__ import annotations

import math

import numpy as np

from q2r2_control.compliance.admittance import Admittance
from q2r2_control.config.cell import Config
from q2r2_control.drives.base import Drive, DriveReport, Openings, ToolTargets, position_command
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, Reference, RobotState

# Velocity mode: how fast the measured position is brought back to the reference [1/s]. A plant that answers with a
# delay T is stable below about 1 / T; at 10 /s that leaves 100 ms.
FEEDBACK_GAIN = 10.0
# A measurement that did not change for more ticks than this is old: the arm has moved on since.
_FRESH_TICKS = 3


class PositionDrive(Drive):
    """The reference is the command. With the admittance enabled, what the tools feel displaces their targets."""

    mode = CommandMode.POSITION

    def __init__(self, robot: Robot, config: Config) -> None:
        self.admittance = Admittance(robot, config.admittance) if config.admittance.enabled else None
        self.report = DriveReport()

    def reset(self, state: RobotState) -> None:
        """See :meth:`Drive.reset`."""
        self.report = DriveReport()
        if self.admittance is None:
            return
        if state.tau_external is None:
            raise ConfigError("admittance.enabled = true: allowed with a plant that measures external torque only")
        self.admittance.reset()

    def displaced(self, targets: ToolTargets, state: RobotState, dt: float) -> ToolTargets:
        """See :meth:`Drive.displaced`."""
        if self.admittance is None:
            return targets
        displaced = self.admittance.update(targets, state, dt)
        self.report = DriveReport(admittance=self.admittance.report())
        return displaced

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        """See :meth:`Drive.command`: what was measured does not matter."""
        return position_command(reference, grippers)


class VelocityDrive(PositionDrive):
    """The reference's velocity, and what brings the measured position back to it:  v = v_ref + k (q_ref - q).

    Within the velocity limits. Without a state to trust, or with one that is some ticks old, there is no feedback, so
    that an old measurement does not drive the arms.
    """

    mode = CommandMode.VELOCITY
    coasts = True

    def __init__(self, robot: Robot, config: Config) -> None:
        super().__init__(robot, config)
        self._limit: Array = robot.velocity_limit * config.control.velocity_scale
        self._stamp, self._ticks = -math.inf, 0  # of the newest state, and since then

    def reset(self, state: RobotState) -> None:
        """See :meth:`Drive.reset`."""
        super().reset(state)
        self._stamp, self._ticks = state.stamp, 0

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        """See :meth:`Drive.command`."""
        v = reference.v
        self._ticks = 0 if state.stamp != self._stamp else self._ticks + 1
        self._stamp = state.stamp
        if trusted and self._ticks <= _FRESH_TICKS and np.isfinite(state.q).all():
            v = v + FEEDBACK_GAIN * (reference.q - state.q)
        bounded = np.minimum(np.maximum(v, -self._limit), self._limit)
        return Command(self.mode, reference.q, bounded, np.zeros_like(reference.q), grippers)

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        """See :meth:`Drive.last_command`: a velocity outlives its sender on many plants, so the last one is zero."""
        zero = np.zeros_like(self._limit)
        return Command(self.mode, np.nan_to_num(state.q), zero, zero, grippers)
