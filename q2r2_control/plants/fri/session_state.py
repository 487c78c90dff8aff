"""The data between the loop and the process that answers the cabinets: states of sessions, and commands for arms."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from q2r2_control.events import Reason
from q2r2_control.plants.fri.answers import CATCH_UP
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.plants.fri.wire import JOINTS, CommandKind, IoValue, Joints, Monitoring, Safety, Session, in_words
from q2r2_control.types import ArmTiming

# Longest time between two answers with torques [s]. With 0.01 s, an arm at the default stiffness is unstable.
TORQUE_PERIOD = 0.005
_SILENT = 0.1  # A cabinet that sends no message for longer than this counts as silent [s].
_LONGEST_LAG = 0.25  # An arm with a larger lag is not commanded, because its cabinet asks too seldom [s].
_EARLY = 5e-4  # Greatest time by which a message can come before it is expected [s].


@dataclass
class SessionState:
    """The session of one arm, as the process that answers its cabinet knows it. Times are of the monotonic clock [s].

    Joints are tuples here and in :class:`ArmCommand`, because both pass between processes, and arrays are slow to
    pickle.
    """

    arm: str
    source: str  # The cabinet's address and port in words.
    wanted: CommandKind = CommandKind.POSITION  # TORQUE stands for an overlay of torques.
    newest: Monitoring | None = None
    arrival: float = -math.inf  # Arrival of the newest message.
    velocity: Joints = (0.0,) * JOINTS  # Measured velocities [rad/s].
    rest: Joints = (0.0,) * JOINTS  # Positions at the end of the arm's path [rad].
    following: bool = False  # True while the arm follows the reference.
    ended: int = 0  # Number of times that the arm ceased to follow because its cabinet ended the session.
    answered: float = -math.inf  # The latest time on the path for which an answer was sent.
    expected: float = -math.inf  # The time at which the question of the newest answer would have come without delay.
    # An answer should be for the time ``DELAY`` before the arrival of its question. The newest answer is for a time
    # that is earlier than this by the lag.
    lag: float = 0.0
    # The lag with ``expected`` in place of the arrival, so that delays of the network do not count.
    behind: float = 0.0
    took: float | None = None  # Time from the newest message until its answer was sent; None if it got no answer.
    lost: int = 0  # Number of lost messages of the cabinet.
    unreadable: int = 0  # Number of unreadable messages.
    problem: str | None = None  # The fault of the newest datagram; None if it has none.

    @property
    def period(self) -> float:
        """Time between two answers [s]; 0 if the cabinet was not heard yet."""
        return 0.0 if self.newest is None else self.newest.period * self.newest.multiplier

    @property
    def is_too_slow(self) -> bool:
        """Whether the cabinet asks too seldom for torques."""
        return self.wanted is CommandKind.TORQUE and self.period > TORQUE_PERIOD

    @property
    def words(self) -> str:
        """The state of the cabinet in words, as its newest message tells it."""
        newest = self.newest
        if newest is None:
            return "not heard"
        return f"{in_words(newest.session)}, connection {in_words(newest.quality)}, drives {in_words(newest.drives)}"

    def is_silent(self, now: float) -> bool:
        return now - self.arrival > _SILENT

    def timing(self, now: float) -> ArmTiming:
        """Return the timing of the arm relative to its reference, at ``now`` [s]."""
        return ArmTiming(self.behind, now - self.arrival, self.period)

    def latest(self, t: float) -> float:
        """Return an upper bound on the times on the path for which answers are sent until ``t`` [s].

        It is -inf if no answer was sent yet.
        """
        if self.period == 0.0 or self.answered == -math.inf:
            return -math.inf
        messages = max(math.floor((t + _EARLY - self.expected) / self.period), 0)
        return self.answered + (1.0 + CATCH_UP) * messages * self.period

    def fault(self, now: float) -> Reason | None:
        """Return why the arm cannot be commanded at ``now`` [s], or None if it can."""
        newest = self.newest
        if newest is None or self.is_silent(now):
            if self.problem is not None:
                return Reason.of(FriReason.FRI_UNREADABLE, arm=self.arm, source=self.source, text=self.problem)
            return Reason.of(FriReason.FRI_SILENT, arm=self.arm, source=self.source)
        if self.is_too_slow:
            period, allowed = 1e3 * self.period, 1e3 * TORQUE_PERIOD
            return Reason.of(FriReason.FRI_TOO_SELDOM, arm=self.arm, period=period, allowed=allowed)
        # Session and safety are both checked. After some stops of the safety controller, the session goes on for a
        # while, but our own stop has to begin at once.
        if newest.session is not Session.COMMANDING_ACTIVE or newest.safety is not Safety.NORMAL:
            states = newest.session, newest.quality, newest.safety, newest.drives
            doing, quality, safety, drives = map(in_words, states)
            return Reason.of(
                FriReason.FRI_SESSION, arm=self.arm, session=doing, quality=quality, safety=safety, drives=drives
            )
        if self.following and self.lag > _LONGEST_LAG:
            return Reason.of(FriReason.FRI_BEHIND, arm=self.arm, period=1e3 * newest.period, lag=self.lag)
        if newest.command is not self.wanted:
            asked, wanted = newest.command.name.lower(), self.wanted.name.lower()
            return Reason.of(FriReason.FRI_COMMAND_MODE, arm=self.arm, asked=asked, wanted=wanted)
        return None


@dataclass
class ArmCommand:
    """The command of one tick for one arm: its reference at the end of the tick, and the certified stop from there."""

    now: float  # Time of the tick [s].
    start: float  # Time at which the reference leaves the earlier stop [s].
    end: float  # Time of the reference's end [s].
    q: Joints  # Posture of the reference at the end of the tick [rad].
    v: Joints  # Velocity of the reference at the end of the tick [rad/s].
    deceleration: Joints  # Deceleration of the stop [rad/s^2].
    outputs: dict[str, IoValue] = field(default_factory=dict)  # New values of the cabinet's outputs, by name.
    tau: Joints | None = None  # Torque overlay [Nm]; None with positions, or if the damping brakes.
    damping: Joints | None = None  # Damping that brakes if no overlay comes [Nm s/rad]; None with positions.
