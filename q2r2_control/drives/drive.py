"""From targets and a reference to a command: one way for each mode in which a plant is driven.

Position mode: the reference is the command; with the admittance enabled, what the tools feel displaces the targets
before the controller sees them. Torque mode: targets stay as they are, and the command is the torque of a Cartesian
impedance about the reference and of the wall between the measured links.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.admittance import Admittance, AdmittanceReport
from q2r2_control.compliance.impedance import ImpedanceController, ImpedanceReport
from q2r2_control.compliance.repulsion import MeasuredSeparation, WallReport
from q2r2_control.config import Config
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.plants.base import Plant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Command, CommandMode, Reference, RobotState

LONGEST_BLIND = 0.05  # in torque mode without a usable measurement, before the run ends [s]
_STILL = 1e-2  # of an arm on its spring [rad/s]

Targets = dict[str, pin.SE3 | None]
Openings = dict[str, float]


@dataclass(frozen=True, slots=True)
class DriveReport:
    """What the mode's own laws did in one tick; None for those of the other mode, or not enabled."""

    impedance: ImpedanceReport | None = None
    wall: WallReport | None = None
    admittance: AdmittanceReport | None = None


class Drive(Protocol):
    """One mode of driving a plant."""

    mode: CommandMode
    report: DriveReport  # of the last tick

    def reset(self, state: RobotState) -> None:
        """Start anew, at rest at the measured ``state``. Raises :class:`Q2R2Error` where that cannot be."""
        ...

    def displaced(self, targets: Targets, state: RobotState, dt: float) -> Targets:
        """The tool targets that the controller is to follow in a tick of ``dt`` [s]."""
        ...

    def command(self, reference: Reference, state: RobotState, grippers: Openings, dt: float) -> Command:
        """What goes to the plant in a tick of ``dt`` [s]; never raises because of a number."""
        ...

    def check(self) -> None:
        """Raises :class:`PlantError` where the run must not go on; commands that bring it to rest still come."""
        ...

    def at_rest(self, state: RobotState) -> bool:
        """Whether the arms stand still, given that the reference does."""
        ...

    def let_go(self, plant: Plant, grippers: Openings) -> None:
        """Leave the arms where they are, since no more commands come."""
        ...


class PositionDrive:
    """The reference is the command."""

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

    def displaced(self, targets: Targets, state: RobotState, dt: float) -> Targets:
        """See :meth:`Drive.displaced`."""
        if self.admittance is None:
            return targets
        displaced = self.admittance.update(targets, state, dt)
        self.report = DriveReport(admittance=self.admittance.report())
        return displaced

    def command(self, reference: Reference, state: RobotState, grippers: Openings, dt: float) -> Command:
        """See :meth:`Drive.command`."""
        return Command(self.mode, reference.q, reference.v, np.zeros_like(reference.q), grippers)

    def check(self) -> None:
        """See :meth:`Drive.check`: the plant's own servos know what they measure."""

    def at_rest(self, state: RobotState) -> bool:
        """See :meth:`Drive.at_rest`."""
        return True

    def let_go(self, plant: Plant, grippers: Openings) -> None:
        """See :meth:`Drive.let_go`: the last command holds them."""


class TorqueDrive:
    """Cartesian impedance about the reference, and a wall between the measured links.

    **Blind.** Without a usable measurement the impedance holds gravity's last torque: nothing is pushed anywhere, but
    nothing brakes either. After ``LONGEST_BLIND`` that ends in a :class:`PlantError`, and from then on the reference
    goes to the plant's position servos, which measure by themselves, so that the arms come to rest with it.
    """

    mode = CommandMode.TORQUE

    def __init__(self, robot: Robot, config: Config) -> None:
        self.impedance = ImpedanceController(robot, config.impedance)
        self.wall = MeasuredSeparation(robot, config.control, config.impedance.wall)
        self.report = DriveReport()
        self._joint_names = robot.joint_names
        self._blind = 0.0  # [s]
        self._reference = robot.home  # the last one (nv,) [rad]

    def reset(self, state: RobotState) -> None:
        """See :meth:`Drive.reset`."""
        self.report = DriveReport()
        self._blind = 0.0
        self._reference, self._state = state.q, state
        self.impedance.reset(state)

    def displaced(self, targets: Targets, state: RobotState, dt: float) -> Targets:
        """See :meth:`Drive.displaced`."""
        return targets

    def command(self, reference: Reference, state: RobotState, grippers: Openings, dt: float) -> Command:
        """See :meth:`Drive.command`."""
        self._reference = reference.q
        if self._blind > LONGEST_BLIND:
            return Command(CommandMode.POSITION, reference.q, reference.v, np.zeros_like(reference.q), grippers)
        wall = self.wall.update(state.q, state.v)
        torque = self.impedance.step(reference, state, dt, wall.tau)
        self.report = DriveReport(torque.report, wall)
        sees = not (torque.report.held or math.isnan(wall.closest_distance))
        self._blind = 0.0 if sees else self._blind + dt
        self._state = state
        return Command(self.mode, reference.q, reference.v, torque.tau, grippers)

    def check(self) -> None:
        """See :meth:`Drive.check`."""
        if self._blind > LONGEST_BLIND:
            raise PlantError(self._fault(self._state))

    def at_rest(self, state: RobotState) -> bool:
        """See :meth:`Drive.at_rest`."""
        # What cannot be seen is not waited for.
        return self._blind > 0.0 or float(np.abs(state.v).max()) <= _STILL

    def let_go(self, plant: Plant, grippers: Openings) -> None:
        """See :meth:`Drive.let_go`: the plant's position servos hold; a torque that nobody renews holds nothing."""
        measured = plant.state().q
        q = measured if np.isfinite(measured).all() else self._reference
        zero = np.zeros_like(q)
        plant.apply(Command(CommandMode.POSITION, q, zero, zero, grippers))

    def _fault(self, state: RobotState) -> str:
        allowed = f"for more than {1e3 * LONGEST_BLIND:g} ms; allowed: finite numbers"
        for what, values in (("position", state.q), ("velocity", state.v)):
            for joint, value in zip(self._joint_names, values, strict=True):
                if not math.isfinite(value):
                    return f"measured {what} of {joint} = {value} {allowed}"
        return f"measured state is of no use {allowed} that a robot can have"


def drive_of(mode: CommandMode | str, plant: Plant, robot: Robot, config: Config) -> Drive:
    """The drive of ``mode``. Raises :class:`ConfigError` for a mode that ``plant`` does not have."""
    if mode not in plant.modes:
        allowed = ", ".join(plant.modes)
        raise ConfigError(f"mode {mode!s:.40}: {type(plant).__name__} follows {allowed} commands only")
    return TorqueDrive(robot, config) if mode == CommandMode.TORQUE else PositionDrive(robot, config)
