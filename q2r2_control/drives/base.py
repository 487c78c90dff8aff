"""Turn a reference into a command for a plant: positions, velocities or torques."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.admittance import Admittance, AdmittanceReport
from q2r2_control.compliance.impedance import ImpedanceController, ImpedanceReport
from q2r2_control.compliance.repulsion import MeasuredSeparation, WallReport
from q2r2_control.config.cell import Config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.drives.command_average import CommandAverage
from q2r2_control.errors import ConfigError
from q2r2_control.robot.command_average import average_window
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, Interval, Reference, RobotState

ToolTargets = dict[str, pin.SE3 | None]
Openings = dict[str, float]


@dataclass(slots=True)
class DriveReport:
    """The reports of one tick: of impedance and wall in torque mode, or of the admittance in the other modes.

    A report is None if it belongs to another mode, or if the wall or the admittance is not enabled.
    """

    impedance: ImpedanceReport | None = None
    wall: WallReport | None = None
    admittance: AdmittanceReport | None = None


class Drive(ABC):
    """Turns references into commands of one mode: positions, velocities or torques."""

    mode: CommandMode
    report: DriveReport  # The reports of the last tick.
    yields = False  # Whether a person may push the arms away from the reference.
    coasts = False  # Whether a plant continues to move by the last command while no new command comes.

    @abstractmethod
    def reset(self, state: RobotState) -> None:
        """Start again, at rest at the measured ``state``; raises :class:`Q2R2Error` if that is not possible."""

    @abstractmethod
    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        """Return the command for the plant. No number in the arguments raises an exception.

        Args:
            reference: The controller's reference.
            state: The measured state.
            grippers: The openings of the grippers.
            dt: Duration of the tick [s].
            trusted: False if ``state`` is too old or implausible, and for the last command of a run. The command must
                then contain no force or feedback that depends on ``state``.
        """

    def average(self, period: float) -> None:  # noqa: B027
        """From now on, command averages of the newest references, which keep the limit of jerk.

        The ticks have the ``period`` [s]. The method is not called for a plant that knows the certified stop and
        averages by itself.
        """

    def set_openings(self, openings: Mapping[str, Interval]) -> None:  # noqa: B027
        """Set the interval of openings that the controller has accepted, for each arm's gripper."""

    def set_holding(self, holding: Mapping[str, bool]) -> None:  # noqa: B027
        """Set for each arm whether its gripper holds its object."""

    def set_kept_distances(self, kept: Array) -> None:  # noqa: B027
        """Set the distance that every pair keeps from now on (p,) [m]."""

    def set_obstacles(self, obstacles: Mapping[str, MovingObstacle]) -> None:  # noqa: B027
        """Set the reported moving obstacles that are at rest, by name."""

    def displaced(self, targets: ToolTargets, state: RobotState, dt: float) -> ToolTargets:
        """Return the targets for the controller in a tick of ``dt`` [s]. With an admittance, they are displaced."""
        return targets

    def at_rest(self, state: RobotState) -> bool:
        """Return whether the arms are at rest too, after the reference has come to rest."""
        return True

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        """Return the command that holds the arms after a run; None if the newest command already holds them."""
        return None


def permitted(settings: ControllerSettings, drive: Drive) -> ControllerSettings:
    """Return the controller's settings that a drive permits.

    Bodies may touch only in torque mode, in which the arms yield. A limit of jerk counts only in the other modes.
    """
    return settings.without_jerk_limit() if drive.yields else settings.without_contact()


def position_command(reference: Reference, grippers: Openings) -> Command:
    """Return the command that follows the reference."""
    return Command(CommandMode.POSITION, reference.q, reference.v, np.zeros(len(reference.q)), grippers)


def holding_command(q: Array, grippers: Openings) -> Command:
    """Return the command that lets the plant's own servos hold the arms at ``q`` (nv,) [rad]."""
    zero = np.zeros_like(q)
    return Command(CommandMode.POSITION, q, zero, zero, grippers)


# Gain of the position feedback [1/s]. If the plant has a delay T, gains below about 1 / T are stable; here T is 100 ms.
FEEDBACK_GAIN = 10.0
# After more ticks than this, a measurement is too old for feedback, because the arm has moved since then.
_FRESH_TICKS = 3
_STILL = 1e-2  # In torque mode, an arm counts as at rest if its joints are slower than this [rad/s].


class PositionDrive(Drive):
    """Commands the positions of the reference. With an admittance, forces at the tools displace their targets.

    With a limit of jerk, the commands are means of the newest references.
    """

    mode = CommandMode.POSITION

    def __init__(self, robot: Robot, config: Config) -> None:
        self.admittance = Admittance(robot, config.admittance) if config.admittance.enabled else None
        self.report = DriveReport()
        self._window = average_window(robot, config.control)
        self._average: CommandAverage | None = None

    def average(self, period: float) -> None:
        self._average = CommandAverage(self._window, period) if self._window else None

    def reset(self, state: RobotState) -> None:
        self.report = DriveReport()
        if self._average is not None:
            self._average.reset(state.q)
        if self.admittance is None:
            return
        if state.tau_external is None:
            raise ConfigError("admittance.enabled = true: allowed with a plant that measures external torque only")
        self.admittance.reset()

    def displaced(self, targets: ToolTargets, state: RobotState, dt: float) -> ToolTargets:
        if self.admittance is None:
            return targets
        displaced = self.admittance.update(targets, state, dt)
        self.report = DriveReport(admittance=self.admittance.report())
        return displaced

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        q, v = self._commanded(reference, dt)
        return Command(self.mode, q, v, np.zeros_like(q), grippers)

    def at_rest(self, state: RobotState) -> bool:
        return self._average is None or self._average.settled

    def _commanded(self, reference: Reference, dt: float) -> tuple[Array, Array]:
        """Return the position [rad] and the velocity [rad/s] to be commanded, (nv,) each."""
        if self._average is None:
            return reference.q, reference.v
        return self._average.update(reference.q, reference.v, dt)


class VelocityDrive(PositionDrive):
    """Commands v = v_ref + k (q_ref - q) within the limits: the reference's velocity, and feedback of the position.

    If the state is not trusted, not finite, or more than ``_FRESH_TICKS`` ticks old, v is v_ref, without feedback.
    """

    mode = CommandMode.VELOCITY
    coasts = True

    def __init__(self, robot: Robot, config: Config) -> None:
        super().__init__(robot, config)
        self._limit: Array = robot.velocity_limit * config.control.velocity_scale
        self._stamp, self._ticks = -math.inf, 0  # Stamp of the newest state, and the number of ticks since then.

    def reset(self, state: RobotState) -> None:
        super().reset(state)
        self._stamp, self._ticks = state.stamp, 0

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        q, v = self._commanded(reference, dt)
        self._ticks = 0 if state.stamp != self._stamp else self._ticks + 1
        self._stamp = state.stamp
        if trusted and self._ticks <= _FRESH_TICKS and np.isfinite(state.q).all():
            v = v + FEEDBACK_GAIN * (q - state.q)
        bounded = np.minimum(np.maximum(v, -self._limit), self._limit)
        return Command(self.mode, q, bounded, np.zeros_like(q), grippers)

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        # The last command is the velocity 0, because many plants continue at the last velocity after the program that
        # sent it has ended.
        zero = np.zeros_like(self._limit)
        return Command(self.mode, np.nan_to_num(state.q), zero, zero, grippers)


class TorqueDrive(Drive):
    """Commands torques that follow the reference. Targets are not displaced, because the spring lets the arms yield.

    **Without a trusted state**, the torque of a spring could push the arms anywhere. If the plant has position servos
    of its own (``has_servos``), the command then contains positions, and the servos follow the reference. Otherwise the
    command is the gravity torque at the newest measured posture, because many drivers repeat the last command for ever.
    The command's flag ``gravity_only`` is then set.
    """

    mode = CommandMode.TORQUE
    yields = True

    def __init__(self, robot: Robot, config: Config, has_servos: bool = True) -> None:
        self.impedance = ImpedanceController(robot, config.impedance)
        self.wall = MeasuredSeparation(robot, config.control, config.impedance.wall)
        self.report = DriveReport()
        self._has_servos = has_servos
        self._believed = self._reference = robot.home  # Last usable measured posture, and last reference (nv,) [rad].

    def reset(self, state: RobotState) -> None:
        self.report = DriveReport()
        self._believed = self._reference = state.q
        self.impedance.reset(state)

    def set_openings(self, openings: Mapping[str, Interval]) -> None:
        self.wall.set_openings(openings)

    def set_holding(self, holding: Mapping[str, bool]) -> None:
        self.impedance.set_holding(holding)

    def set_kept_distances(self, kept: Array) -> None:
        self.wall.set_kept_distances(kept)

    def set_obstacles(self, obstacles: Mapping[str, MovingObstacle]) -> None:
        self.wall.set_obstacles(obstacles)

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        self._reference = reference.q
        if not trusted:
            self.report = DriveReport()
            if self._has_servos:
                return position_command(reference, grippers)
            gravity = self.impedance.gravity(self._posture(state))
            return Command(self.mode, reference.q, reference.v, gravity, grippers, gravity_only=True)
        wall = self.wall.update(state.q, state.v)
        torque = self.impedance.step(reference, state, dt, wall.tau)
        self.report = DriveReport(torque.report, wall)
        if not torque.report.held:
            self._believed = state.q
        return Command(self.mode, reference.q, reference.v, torque.tau, grippers)

    def at_rest(self, state: RobotState) -> bool:
        # If the measurement is not finite, the arms count as at rest. Otherwise the caller would wait for ever.
        seen = np.isfinite(state.q).all() and np.isfinite(state.v).all()
        return not seen or float(np.abs(state.v).max()) <= _STILL

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        # Position servos can hold the arms. A torque that is no longer updated cannot hold them.
        if self._has_servos:
            return holding_command(state.q if np.isfinite(state.q).all() else self._reference, grippers)
        q = self._posture(state)
        return Command(self.mode, q, np.zeros_like(q), self.impedance.gravity(q), grippers, gravity_only=True)

    def _posture(self, state: RobotState) -> Array:
        """Return the newest measured posture that was finite."""
        return state.q if np.isfinite(state.q).all() else self._believed


def make_drive(mode: CommandMode, robot: Robot, config: Config, has_servos: bool = True) -> Drive:
    """Return the drive of ``mode``; ``has_servos`` says if the plant can follow positions when torques are not safe."""
    if mode is CommandMode.TORQUE:
        return TorqueDrive(robot, config, has_servos)
    return VelocityDrive(robot, config) if mode is CommandMode.VELOCITY else PositionDrive(robot, config)
