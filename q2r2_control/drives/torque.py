"""Torque mode: a Cartesian impedance about the reference, and the repulsion between the measured links."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.compliance.repulsion import MeasuredSeparation
from q2r2_control.config.cell import Config
from q2r2_control.drives.base import Drive, DriveReport, Openings, holding_command, position_command
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, Interval, Reference, RobotState

_STILL = 1e-2  # of an arm on its spring [rad/s]


class TorqueDrive(Drive):
    """Turns references into torques. Targets stay as they are: the spring is the compliance.

    **Without a state to trust.** A spring about a posture that was measured long ago could push anywhere. A plant with
    position servos (``has_servos``), which measure by themselves, follows the reference by those, so that the arms come
    to rest with it. Otherwise the command is gravity's torque at the newest measured posture: many drivers
    repeat the last command for ever, and gravity's does no harm.
    """

    mode = CommandMode.TORQUE
    yields = True

    def __init__(self, robot: Robot, config: Config, has_servos: bool = True) -> None:
        self.impedance = ImpedanceController(robot, config.impedance)
        self.wall = MeasuredSeparation(robot, config.control, config.impedance.wall)
        self.report = DriveReport()
        self._has_servos = has_servos
        self._believed = self._reference = robot.home  # the last posture and reference (nv,) [rad]

    def reset(self, state: RobotState) -> None:
        """See :meth:`Drive.reset`."""
        self.report = DriveReport()
        self._believed = self._reference = state.q
        self.impedance.reset(state)

    def set_openings(self, openings: Mapping[str, Interval]) -> None:
        """See :meth:`Drive.set_openings`: the wall's fingers are the controller's."""
        self.wall.set_openings(openings)

    def set_holding(self, holding: Mapping[str, bool]) -> None:
        """See :meth:`Drive.set_holding`: the impedance bears it. The wall knows no objects: they may touch."""
        self.impedance.set_holding(holding)

    def set_kept_distances(self, kept: Array) -> None:
        """See :meth:`Drive.set_kept_distances`: the wall begins there."""
        self.wall.set_kept_distances(kept)

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        """See :meth:`Drive.command`. A state that is not finite is bridged with the last gravity torque."""
        self._reference = reference.q
        if not trusted:
            self.report = DriveReport()
            if self._has_servos:
                return position_command(reference, grippers)
            return Command(self.mode, reference.q, reference.v, self.gravity(self._posture(state)), grippers)
        wall = self.wall.update(state.q, state.v)
        torque = self.impedance.step(reference, state, dt, wall.tau)
        self.report = DriveReport(torque.report, wall)
        if not torque.report.held:
            self._believed = state.q
        return Command(self.mode, reference.q, reference.v, torque.tau, grippers)

    def gravity(self, q: Array) -> Array:
        """What bears the arms at a posture ``q`` (nv,) [rad]: torques (nv,) [Nm]."""
        return self.impedance.gravity(q)

    def at_rest(self, state: RobotState) -> bool:
        """See :meth:`Drive.at_rest`. What cannot be seen is not waited for."""
        seen = np.isfinite(state.q).all() and np.isfinite(state.v).all()
        return not seen or float(np.abs(state.v).max()) <= _STILL

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        """See :meth:`Drive.last_command`: a torque that nobody renews holds nothing, position servos do."""
        if self._has_servos:
            return holding_command(state.q if np.isfinite(state.q).all() else self._reference, grippers)
        q = self._posture(state)
        return Command(self.mode, q, np.zeros_like(q), self.gravity(q), grippers)

    def _posture(self, state: RobotState) -> Array:
        """The newest measured posture that was a posture."""
        return state.q if np.isfinite(state.q).all() else self._believed
