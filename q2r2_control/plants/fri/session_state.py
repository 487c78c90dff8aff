"""Between the loop and the process that answers the cabinets: how a session is, and where an arm is to go."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.plants.fri.answers import CATCH_UP
from q2r2_control.plants.fri.wire import JOINTS, CommandKind, IoValue, Joints, Monitoring, Safety, Session, in_words
from q2r2_control.types import ArmTiming

TORQUE_PERIOD = 0.005  # between two answers at most: with 0.01 the arm swings up at the default stiffness [s]
_SILENT = 0.1  # a cabinet without a message for longer is gone [s]
_LONGEST_LAG = 0.25  # a cabinet that asks so much too seldom is not followed any more [s]
_EARLY = 5e-4  # a message may come so much before it is expected [s]


@dataclass
class SessionState:
    """One arm's session, as the process that answers its cabinet knows it. Times are of the monotonic clock [s].

    Joints are tuples here and in :class:`ArmCommand`: both pass between processes, and arrays are slow to pickle.
    """

    arm: str
    source: str  # the cabinet in words
    wanted: CommandKind = CommandKind.POSITION  # or TORQUE: an overlay of torques
    newest: Monitoring | None = None
    arrival: float = -math.inf  # of the newest message
    velocity: Joints = (0.0,) * JOINTS  # measured [rad/s]
    rest: Joints = (0.0,) * JOINTS  # where the arm's path ends [rad]
    following: bool = False
    ended: int = 0  # how often the arm ceased to follow, since the cabinet ended its session
    answered: float = -math.inf  # the latest time that an answer was for
    expected: float = -math.inf  # when the message of that answer would have come, had nothing made it late
    lag: float = 0.0  # of the answers behind where they are to be
    behind: float = 0.0  # the same by the cabinet's clock, whenever its messages arrive
    took: float | None = None  # from the newest message's arrival until its answer was sent; None: it got none
    lost: int = 0  # messages of the cabinet
    unreadable: int = 0
    problem: str | None = None  # with the newest datagram

    @property
    def period(self) -> float:
        """Between two answers [s]; 0 where the cabinet was not heard."""
        return 0.0 if self.newest is None else self.newest.period * self.newest.multiplier

    @property
    def is_too_slow(self) -> bool:
        """For torques."""
        return self.wanted is CommandKind.TORQUE and self.period > TORQUE_PERIOD

    @property
    def words(self) -> str:
        """How the cabinet says that it is."""
        newest = self.newest
        if newest is None:
            return "not heard"
        return f"{in_words(newest.session)}, connection {in_words(newest.quality)}, drives {in_words(newest.drives)}"

    def is_silent(self, now: float) -> bool:
        return now - self.arrival > _SILENT

    def timing(self, now: float) -> ArmTiming:
        """When the arm does what its reference says, at ``now`` [s]."""
        return ArmTiming(self.behind, now - self.arrival, self.period)

    def latest(self, t: float) -> float:
        """The latest time that an answer until ``t`` may be for [s]."""
        if self.period == 0.0 or self.answered == -math.inf:
            return -math.inf
        messages = max(math.floor((t + _EARLY - self.expected) / self.period), 0)
        return self.answered + (1.0 + CATCH_UP) * messages * self.period

    def fault(self, now: float) -> Reason | None:
        """Why the arm cannot be commanded at ``now`` [s], or None."""
        newest = self.newest
        if newest is None or self.is_silent(now):
            if self.problem is not None:
                return Reason.of(ReasonKind.FRI_UNREADABLE, arm=self.arm, source=self.source, text=self.problem)
            return Reason.of(ReasonKind.FRI_SILENT, arm=self.arm, source=self.source)
        if self.is_too_slow:
            period, allowed = 1e3 * self.period, 1e3 * TORQUE_PERIOD
            return Reason.of(ReasonKind.FRI_TOO_SELDOM, arm=self.arm, period=period, allowed=allowed)
        # Some stops of the safety controller let the session go on for a while, in which our own stop is to begin.
        if newest.session is not Session.COMMANDING_ACTIVE or newest.safety is not Safety.NORMAL:
            states = newest.session, newest.quality, newest.safety, newest.drives
            doing, quality, safety, drives = map(in_words, states)
            return Reason.of(
                ReasonKind.FRI_SESSION, arm=self.arm, session=doing, quality=quality, safety=safety, drives=drives
            )
        if self.following and self.lag > _LONGEST_LAG:
            return Reason.of(ReasonKind.FRI_BEHIND, arm=self.arm, period=1e3 * newest.period, lag=self.lag)
        if newest.command is not self.wanted:
            asked, wanted = newest.command.name.lower(), self.wanted.name.lower()
            return Reason.of(ReasonKind.FRI_COMMAND_MODE, arm=self.arm, asked=asked, wanted=wanted)
        return None


@dataclass
class ArmCommand:
    """One tick's command for one arm: its reference at the end of the tick, and the certified stop from there."""

    now: float  # of the tick [s]
    start: float  # when the reference leaves the stop of before [s]
    end: float  # [s]
    q: Joints  # [rad]
    v: Joints  # [rad/s]
    deceleration: Joints  # of the stop [rad/s^2]
    outputs: dict[str, IoValue] = field(default_factory=dict)  # of the cabinet, by name; those that are set
    tau: Joints | None = None  # overlay [Nm]; None: positions, or the damping brakes
    damping: Joints | None = None  # that brakes where no overlay comes [Nm s/rad]; None: positions
