"""Modes of driving a plant, by position, velocity or torque: from tool targets and a reference to a command."""

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
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, Interval, Reference, RobotState

ToolTargets = dict[str, pin.SE3 | None]
Openings = dict[str, float]


@dataclass(slots=True)
class DriveReport:
    """Outcome of the mode's own laws in one tick; None for those of the other modes, or not enabled."""

    impedance: ImpedanceReport | None = None
    wall: WallReport | None = None
    admittance: AdmittanceReport | None = None


class Drive(ABC):
    """One mode of driving a plant."""

    mode: CommandMode
    report: DriveReport  # of the last tick
    yields = False  # whether arms that are pushed leave the reference by design
    coasts = False  # whether a plant goes on moving by the last command while none comes

    @abstractmethod
    def reset(self, state: RobotState) -> None:
        """Start anew, at rest at the measured ``state``. Raises :class:`Q2R2Error` where that cannot be."""

    @abstractmethod
    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        """The command to the plant in a tick of ``dt`` [s]; never raises because of a number.

        ``trusted`` is False where ``state`` is out of date or not to be believed, and for the last command before there
        are no more. Terms that push according to the state must not push then.
        """

    def set_openings(self, openings: Mapping[str, Interval]) -> None:  # noqa: B027
        """Between which openings each arm's gripper is, as the controller has accepted it."""

    def set_holding(self, holding: Mapping[str, bool]) -> None:  # noqa: B027
        """Of each arm whose gripper has an object, whether it is held."""

    def set_kept_distances(self, kept: Array) -> None:  # noqa: B027
        """How far apart every pair stays from now on, (p,) [m], as the controller's settings were changed."""

    def set_obstacles(self, obstacles: Mapping[str, MovingObstacle]) -> None:  # noqa: B027
        """The moving obstacles that stay where they are, by name."""

    def displaced(self, targets: ToolTargets, state: RobotState, dt: float) -> ToolTargets:
        """The tool targets that the controller is to follow in a tick of ``dt`` [s]."""
        return targets

    def at_rest(self, state: RobotState) -> bool:
        """Whether the arms stand still, given that the reference does."""
        return True

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        """The command that holds the arms when no more commands come; None: the last one does."""
        return None


def permitted(settings: ControllerSettings, drive: Drive) -> ControllerSettings:
    """The controller's settings as far as a drive permits them: only where arms yield may bodies touch."""
    return settings if drive.yields else settings.without_contact()


def position_command(reference: Reference, grippers: Openings) -> Command:
    """The reference itself."""
    return Command(CommandMode.POSITION, reference.q, reference.v, np.zeros(len(reference.q)), grippers)


def holding_command(q: Array, grippers: Openings) -> Command:
    """Stand still at ``q`` (nv,) [rad], held by the plant's own servos."""
    zero = np.zeros_like(q)
    return Command(CommandMode.POSITION, q, zero, zero, grippers)


# Of the way from the measured position back to the reference [1/s]. A plant that answers with a delay T is stable below
# about 1 / T, here 100 ms.
FEEDBACK_GAIN = 10.0
_FRESH_TICKS = 3  # a measurement that did not change for longer is old: the arm has moved on since
_STILL = 1e-2  # of an arm on its spring [rad/s]


class PositionDrive(Drive):
    """The reference is the command. With the admittance enabled, what the tools feel displaces their targets."""

    mode = CommandMode.POSITION

    def __init__(self, robot: Robot, config: Config) -> None:
        self.admittance = Admittance(robot, config.admittance) if config.admittance.enabled else None
        self.report = DriveReport()

    def reset(self, state: RobotState) -> None:
        self.report = DriveReport()
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
        return position_command(reference, grippers)


class VelocityDrive(PositionDrive):
    """The reference's velocity, and feedback of the measured position:  v = v_ref + k (q_ref - q),  within the limits.

    Without a state to trust, or with one that is some ticks old, there is no feedback.
    """

    mode = CommandMode.VELOCITY
    coasts = True

    def __init__(self, robot: Robot, config: Config) -> None:
        super().__init__(robot, config)
        self._limit: Array = robot.velocity_limit * config.control.velocity_scale
        self._stamp, self._ticks = -math.inf, 0  # of the newest state, and since then

    def reset(self, state: RobotState) -> None:
        super().reset(state)
        self._stamp, self._ticks = state.stamp, 0

    def command(
        self, reference: Reference, state: RobotState, grippers: Openings, dt: float, trusted: bool = True
    ) -> Command:
        v = reference.v
        self._ticks = 0 if state.stamp != self._stamp else self._ticks + 1
        self._stamp = state.stamp
        if trusted and self._ticks <= _FRESH_TICKS and np.isfinite(state.q).all():
            v = v + FEEDBACK_GAIN * (reference.q - state.q)
        bounded = np.minimum(np.maximum(v, -self._limit), self._limit)
        return Command(self.mode, reference.q, bounded, np.zeros_like(reference.q), grippers)

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        # A velocity outlives its sender on many plants.
        zero = np.zeros_like(self._limit)
        return Command(self.mode, np.nan_to_num(state.q), zero, zero, grippers)


class TorqueDrive(Drive):
    """Turns references into torques. Targets stay as they are: the spring is the compliance.

    **Without a state to trust.** A spring about a posture that was measured long ago could push anywhere. A plant with
    position servos (``has_servos``), which measure by themselves, follows the reference by those. Otherwise the command
    is gravity's torque at the newest measured posture, and says so: many drivers repeat the last command for ever.
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
        # An unseen motion is not waited for.
        seen = np.isfinite(state.q).all() and np.isfinite(state.v).all()
        return not seen or float(np.abs(state.v).max()) <= _STILL

    def last_command(self, state: RobotState, grippers: Openings) -> Command | None:
        # A torque that nobody renews holds nothing, position servos do.
        if self._has_servos:
            return holding_command(state.q if np.isfinite(state.q).all() else self._reference, grippers)
        q = self._posture(state)
        return Command(self.mode, q, np.zeros_like(q), self.impedance.gravity(q), grippers, gravity_only=True)

    def _posture(self, state: RobotState) -> Array:
        """The newest measured posture that was a posture."""
        return state.q if np.isfinite(state.q).all() else self._believed


def make_drive(mode: CommandMode, robot: Robot, config: Config, has_servos: bool = True) -> Drive:
    """The drive of ``mode``; ``has_servos``: whether the plant follows positions too when torques are not safe."""
    if mode is CommandMode.TORQUE:
        return TorqueDrive(robot, config, has_servos)
    return VelocityDrive(robot, config) if mode is CommandMode.VELOCITY else PositionDrive(robot, config)
