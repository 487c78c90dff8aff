"""The session with one cabinet, in a time that is passed in: a datagram in, the answer to it out."""

from __future__ import annotations

import math

import numpy as np

from q2r2_control.errors import ProtocolError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.plants.fri.answers import AnswerTimes, ReferencePath
from q2r2_control.plants.fri.wire import (
    JOINTS,
    Command,
    CommandKind,
    IoValue,
    Monitoring,
    Session,
    in_words,
    read_monitoring,
    write_command,
)
from q2r2_control.types import Array

# An answer is for so long before its question arrived, by which time the loop has ticked, on a busy machine too [s].
DELAY = 0.004
_SILENT = 0.1  # a cabinet without a message for longer is gone [s]
_LONGEST_LAG = 0.25  # a cabinet that asks so much too seldom is not followed any more [s]
_AT_REST = 1e-9  # [rad]
_RESTARTED = 1000  # a counter that is back by more is that of a session that began anew
_COUNTERS = 1 << 32
_MOST_AHEAD = 20  # messages that may come at once after a moment without any
# A torque that nobody renews is a push without end: one that brakes follows it, and after a while no answer, so that
# the cabinet ends the session [s].
_TORQUE_LASTS, _TORQUE_GONE = 0.02, 0.1
_TORQUE_PERIOD = 0.005  # between two answers at most: with 0.01 the arm swings up at the default stiffness [s]


class ArmSession:
    """One arm. While ``following``, its answers are on the reference's ``path``; else it is held where it is."""

    def __init__(self, arm: str, source: str, version: int | None = None) -> None:
        """``source``: the cabinet in words; ``version`` of FRI, None: either."""
        self._arm, self._source, self._version = arm, source, version
        self.wanted = CommandKind.POSITION  # or TORQUE: an overlay of torques
        self.newest: Monitoring | None = None
        self.arrival = -math.inf  # of the newest message [s]
        self.velocity: Array = np.zeros(JOINTS)  # measured [rad/s]
        self.path = ReferencePath(0.0, np.zeros(JOINTS))
        self.following = self.dropped = False  # and whether the arm ceased to follow
        self.answered = -math.inf  # the latest time that an answer was for [s]
        self.tau, self.tau_came = np.zeros(JOINTS), -math.inf  # overlay [Nm], and when it was decided on [s]
        self.damping = np.zeros(JOINTS)  # that brakes where no overlay comes [Nm s/rad]
        self.torque_limit = np.full(JOINTS, math.inf)  # of overlays [Nm]
        self.outputs: dict[str, IoValue] = {}  # of the cabinet, by name
        self._lag = 0.0  # of the answers behind where they are to be [s]
        self.lost = self.unreadable = 0  # messages of the cabinet
        self._answers = 0
        self._times: AnswerTimes | None = None
        self._begun = False  # the cabinet's own position is known, where the path begins
        self._problem: ProtocolError | None = None  # with the newest datagram

    @property
    def period(self) -> float:
        """Between two answers [s]; 0 where the cabinet was not heard."""
        return 0.0 if self.newest is None else self.newest.period * self.newest.multiplier

    @property
    def words(self) -> str:
        """How the cabinet says that it is."""
        newest = self.newest
        if newest is None:
            return "not heard"
        return f"{in_words(newest.session)}, connection {in_words(newest.quality)}, drives {in_words(newest.drives)}"

    def fault(self, now: float) -> Reason | None:
        """Why the arm cannot be commanded at ``now`` [s], or None."""
        newest, age = self.newest, now - self.arrival
        if newest is None or age > _SILENT:
            if self._problem is not None:
                return Reason.of(ReasonKind.FRI_UNREADABLE, arm=self._arm, source=self._source, text=str(self._problem))
            return Reason.of(ReasonKind.FRI_SILENT, arm=self._arm, source=self._source)
        if self._is_too_slow(newest):
            period, allowed = 1e3 * self.period, 1e3 * _TORQUE_PERIOD
            return Reason.of(ReasonKind.FRI_TOO_SELDOM, arm=self._arm, period=period, allowed=allowed)
        if newest.session is not Session.COMMANDING_ACTIVE:
            states = newest.session, newest.quality, newest.safety, newest.drives
            doing, quality, safety, drives = map(in_words, states)
            return Reason.of(
                ReasonKind.FRI_SESSION, arm=self._arm, session=doing, quality=quality, safety=safety, drives=drives
            )
        if self.following and self._lag > _LONGEST_LAG:
            return Reason.of(ReasonKind.FRI_BEHIND, arm=self._arm, period=1e3 * newest.period, lag=self._lag)
        if newest.command is not self.wanted:
            asked, wanted = newest.command.name.lower(), self.wanted.name.lower()
            return Reason.of(ReasonKind.FRI_COMMAND_MODE, arm=self._arm, asked=asked, wanted=wanted)
        return None

    def answer(self, datagram: bytes, now: float) -> bytes | None:
        """Take a message that came at ``now`` [s]; returns the datagram that answers it, if one is due."""
        try:
            message = read_monitoring(datagram)
            self._check(message, now)
        except ProtocolError as error:
            self.unreadable, self._problem = self.unreadable + 1, error
            return None
        if not self._take(message, now) or message.counter % message.multiplier:
            return None
        if message.session is Session.IDLE:
            return None
        command = self._command(message, now)
        if command is None:
            return None
        self._answers += 1
        return write_command(command, message.version)

    def _check(self, message: Monitoring, now: float) -> None:
        """Raises :class:`ProtocolError` for a message that cannot be this cabinet's."""
        if self._version not in (None, message.version):
            raise ProtocolError(f"FRI {message.version}: allowed by the YAML: {self._version}")
        before, passed = self.newest, now - self.arrival
        if before is None or passed > _SILENT:
            return
        if message.version != before.version:
            raise ProtocolError(f"FRI {message.version} amid messages of FRI {before.version}")
        ahead = _ahead(message, before)
        if ahead > 2.0 * passed / message.period + _MOST_AHEAD:
            raise ProtocolError(f"FRI message counter {ahead} ahead, {passed:.3f} s after the last one")

    def _take(self, message: Monitoring, now: float) -> bool:
        """Note a message; False for one that is older than the newest."""
        before, self._problem = self.newest, None
        if before is None or now - self.arrival > _SILENT:
            passed = 0
            self._begin_anew()
        else:
            passed = _ahead(message, before)
            if -_RESTARTED < passed < 0:
                return False
            if passed < 0:
                passed = 0
                self._begin_anew()
        if before is not None and (message.period, message.multiplier) != (before.period, before.multiplier):
            self._begin_anew()
        if passed > 0 and before is not None:
            self.lost += passed - 1
            speed = np.subtract(message.q, before.q) / (passed * message.period)
            self.velocity = 0.5 * (self.velocity + speed)
        elif passed == 0 and before is not None and message.counter != before.counter:
            self.velocity = np.zeros(JOINTS)
        self.newest, self.arrival = message, now
        return True

    def _begin_anew(self) -> None:
        """The arm is where its cabinet says next."""
        self.dropped |= self.following
        self.following = self._begun = False
        self._times = None

    def _is_too_slow(self, message: Monitoring) -> bool:
        return self.wanted is CommandKind.TORQUE and message.period * message.multiplier > _TORQUE_PERIOD

    def _command(self, message: Monitoring, now: float) -> Command | None:
        counter, reflected = self._answers, message.counter
        if message.session < Session.COMMANDING_WAIT:
            self._begin_anew()
            mirrored = message.commanded_q or message.q  # which FRI 1 expects, and FRI 2 does without
            return Command(counter, reflected, mirrored if message.version == 1 else None, io=self.outputs)
        if self._times is None:
            self._times = AnswerTimes(message.period * message.multiplier, DELAY)
        if message.session is Session.COMMANDING_WAIT or not self._begun:
            # The first command has to equal the cabinet's own position, and the reference begins there.
            self.dropped |= self.following
            self.following, self._begun = False, True
            self.path = ReferencePath(now, np.array(message.ipo_q or message.q))
            self._times.restart()
        if self.wanted is CommandKind.TORQUE:
            return self._torque(message, now)
        time = self._times.at(message.counter, now, counter, message.reflected)
        self.answered, self._lag = max(self.answered, time), now - DELAY - time
        there = self.path.at(time)
        if abs(self._lag) > message.period and np.abs(there - self.path.rest).max() <= _AT_REST:
            self._times.restart()  # where nothing moves, the next answer may be for any time
        return Command(counter, reflected, tuple(there.tolist()), io=self.outputs)

    def _torque(self, message: Monitoring, now: float) -> Command | None:
        """The newest overlay, or one that brakes, with the cabinet's own position as KUKA's example clients have it."""
        age = now - self.tau_came
        if self._is_too_slow(message) or (message.session is Session.COMMANDING_ACTIVE and age > _TORQUE_GONE):
            return None
        wanted = self.tau if self.following and age <= _TORQUE_LASTS else -self.damping * self.velocity
        tau = tuple(np.clip(wanted, -self.torque_limit, self.torque_limit).tolist())
        return Command(self._answers, message.counter, message.ipo_q or message.q, tau, self.outputs)


def _ahead(message: Monitoring, before: Monitoring) -> int:
    """By how many messages it is newer; negative: older."""
    return (message.counter - before.counter + _COUNTERS // 2) % _COUNTERS - _COUNTERS // 2
