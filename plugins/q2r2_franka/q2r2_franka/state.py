"""The messages between the loop and the process that answers the robots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from q2r2_control import CommandMode, Reason
from q2r2_control.plants import ArmTiming
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.reasons import FrankaReason

Joints = tuple[float, ...]
NONE: Joints = (0.0,) * JOINTS
_SILENT = 0.1  # A robot that sends no state for longer than this counts as silent [s].
# The longest recent time between two states is called the usual time. It is at most _LONGEST_USUAL [s], and each state
# shortens it by the share _FORGETTING. One arm may be ahead of the other arm by the usual time. Therefore the
# controller keeps the arms farther apart.
_LONGEST_USUAL, _FORGETTING = 0.02, 0.002


class Mode(StrEnum):
    """The mode of a robot, as pylibfranka names it. ABSENT means that there is no connection."""

    ABSENT = "absent"
    OTHER = "Other"
    IDLE = "Idle"
    MOVE = "Move"
    GUIDING = "Guiding"
    REFLEX = "Reflex"
    USER_STOPPED = "UserStopped"
    RECOVERY = "AutomaticErrorRecovery"


@dataclass(slots=True)
class Measured:
    """One state of a robot."""

    mode: Mode
    errors: str  # Names of the present errors; "" if there are none.
    cycles: int  # Number of periods since the last state that was read.
    q: Joints  # Measured positions [rad].
    v: Joints  # Measured velocities [rad/s].
    tau: Joints  # Measured torques [Nm].
    external: Joints  # Estimated external torques [Nm].
    # Positions to which the robot's own controller moves or holds the arm [rad]. They are those of the last command
    # that the robot took. In a period without a command, the robot computes them itself.
    held: Joints
    held_tau: Joints  # Torques of the last command that the robot took, without gravity [Nm].


@dataclass(slots=True)
class SessionState:
    """The session of one arm, as the process that answers its robot knows it. Times are by the monotonic clock [s]."""

    arm: str
    address: str
    wanted: CommandMode = CommandMode.POSITION
    newest: Measured | None = None
    arrival: float = -math.inf  # Time at which the newest state came.
    usual: float = PERIOD  # Usual time between two states.
    controlled: bool = False  # True while commands move the robot.
    following: bool = False  # True while the arm follows the reference.
    ended: int = 0  # Number of times that the arm ceased to follow because the robot ended the motion.
    rest: Joints = NONE  # Positions at the end of the arm's path [rad].
    # The newest command belongs to this time of the reference [s]. The robot's states advance this time.
    answered: float = -math.inf
    behind: float = 0.0  # Time by which ``answered`` is behind the other arm's ``answered`` [s].
    took: float | None = None  # Time from the newest state until its command was sent; None without a command [s].
    lost: int = 0  # Number of periods in which the robot got no command in time.
    problem: str = ""  # Why there is no connection, or why the robot ended the last motion.

    def is_silent(self, now: float) -> bool:
        return now - self.arrival > _SILENT

    def hear(self, measured: Measured, now: float) -> None:
        """Store a state of the robot that came at ``now`` [s]."""
        passed = min(now - self.arrival, _LONGEST_USUAL)
        self.usual = max(passed, (1.0 - _FORGETTING) * self.usual, PERIOD)
        self.newest, self.arrival, self.took = measured, now, None

    def timing(self, now: float) -> ArmTiming:
        """Return the timing of the arm at ``now`` [s].

        The timing has the arm's delay behind the other arm, the age of the newest state, and the usual time between
        states.
        """
        behind = self.behind if self.wanted is CommandMode.POSITION else 0.0
        return ArmTiming(behind, now - self.arrival, self.usual)

    def latest(self, t: float) -> float:
        """Return an upper bound on ``answered`` at ``t`` [s], if the robot goes on sending states."""
        return self.answered + max(t - self.arrival, 0.0) + PERIOD

    @property
    def words(self) -> str:
        """The state of the robot in words."""
        if self.newest is None or self.newest.mode is Mode.ABSENT:
            return f"no connection to {self.address}"
        errors = f", errors {self.newest.errors}" if self.newest.errors else ""
        return f"mode {self.newest.mode}{errors}"

    def fault(self, now: float) -> Reason | None:
        """Return why the arm cannot be commanded at ``now`` [s]; None if it can."""
        arm, address = self.arm, self.address
        newest = self.newest
        if newest is None or newest.mode is Mode.ABSENT:
            return Reason.of(
                FrankaReason.FRANKA_UNREACHABLE, arm=arm, address=address, text=self.problem or "it is not tried yet"
            )
        if self.is_silent(now):
            return Reason.of(FrankaReason.FRANKA_SILENT, arm=arm, address=address)
        if self.controlled:
            return None
        if newest.mode not in (Mode.IDLE, Mode.MOVE) or newest.errors:
            errors = newest.errors or "none"
            return Reason.of(
                FrankaReason.FRANKA_NOT_READY, arm=arm, address=address, mode=str(newest.mode), errors=errors
            )
        return Reason.of(FrankaReason.FRANKA_STARTING, arm=arm, address=address)


@dataclass(slots=True)
class ArmCommand:
    """The command of one tick for one arm.

    It has the arm's reference at the end of the tick, and the certified stop that begins there.
    """

    now: float  # Time of the tick by the monotonic clock [s].
    start: float  # At this time of the reference [s], it leaves the previous tick's stop, and this tick's step begins.
    end: float  # At this time of the reference [s], the step of this tick ends.
    q: Joints  # Posture at the time ``end`` [rad].
    v: Joints  # Velocity at the time ``end`` [rad/s].
    deceleration: Joints  # Deceleration of the stop [rad/s^2].
    tau: Joints | None = None  # Torques without gravity [Nm]; None in position mode, or if the damping brakes the arm.
    damping: Joints | None = None  # Damping that brakes the arm if no torques come [Nm s/rad]; None in position mode.
