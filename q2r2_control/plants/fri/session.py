"""The session with one cabinet, in a time that is passed in: a datagram in, the answer to it out."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from q2r2_control.errors import ProtocolError
from q2r2_control.plants.fri.answers import AnswerTimes, MessageClock, ReferencePath
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import (
    JOINTS,
    CommandKind,
    FriCommand,
    IoValue,
    Monitoring,
    Session,
    joints_of,
    read_monitoring,
    write_command,
)
from q2r2_control.types import Array

# An answer is for so long before its question arrived, by which time the loop has ticked, on a busy machine too [s].
DELAY = 0.004
_AT_REST = 1e-9  # [rad]
_RESTARTED = 1000  # a counter that is back by more is that of a session that began anew
_COUNTERS = 1 << 32
_MOST_AHEAD = 20  # messages that may come at once after a moment without any
# A torque that nobody renews is a push without end: one that brakes follows it, and after a while no answer, so that
# the cabinet ends the session [s].
_TORQUE_LASTS, _TORQUE_GONE = 0.02, 0.1
_BRAKING_RATE = 5000.0  # of torques at least: a slower damping would come too late [Nm/s]
# Of a reference that begins where its arm is held, or, with torques, where it is measured [rad].
_SAME, _NEAR = 1e-6, 0.02
_FROM_REST = 20.0  # more than a joint's acceleration in the first tick [rad/s^2]


class ArmSession:
    """One arm. While it follows, its answers are on the reference's ``path``; else it is held where it is."""

    def __init__(
        self,
        arm: str,
        source: str,
        version: int | None = None,
        wanted: CommandKind = CommandKind.POSITION,
        torque_limit: Array | None = None,
        velocity_limit: Array | None = None,
        torque_rate_limit: float = math.inf,
    ) -> None:
        """``source``: the cabinet in words; ``version`` of FRI, None: either.

        ``torque_limit`` (n,): of overlays; ``velocity_limit`` (n,): none is measured beyond. A position that jumps once
        lets the damping then push a joint back by the way of one period at that speed, and no further.
        ``torque_rate_limit``: between two answers [Nm/s]. The damping keeps it too, or 5000 where that is lower.
        """
        self.state, self._version = SessionState(arm, source, wanted), version
        self.path = ReferencePath(0.0, np.zeros(JOINTS))
        # Overlay [Nm], or None: the damping; and when that was decided on [s].
        self._tau: Array | None = None
        self._tau_came = -math.inf
        self._damping = np.zeros(JOINTS)  # that brakes where no overlay comes [Nm s/rad]
        none = np.full(JOINTS, math.inf)
        self._torque_limit = none if torque_limit is None else torque_limit
        self._torque_rate_limit = max(torque_rate_limit, _BRAKING_RATE)
        self._tau_sent = np.zeros(JOINTS)
        self._velocity_limit = joints_of(none if velocity_limit is None else velocity_limit)
        self._outputs: dict[str, IoValue] = {}
        self._answers = 0
        self._times: AnswerTimes | None = None
        self._clock = MessageClock(-math.inf)
        self.waits = 0.0  # how far its answers wait for the other arms [s]
        self._begun = False  # the cabinet's own position is known, where the path begins

    def is_still(self, now: float) -> bool:
        """Whether nothing moves the arm at ``now`` [s] if no more commands come."""
        if not self._begun or self.state.is_silent(now):
            return True
        if self.state.wanted is CommandKind.TORQUE:
            return not self.state.following or now - self._tau_came > _TORQUE_GONE
        return self._rests(self.state.answered)

    def _rests(self, t: float) -> bool:
        """Whether the path has come to its end at ``t`` [s]."""
        return bool(np.abs(self.path.at(t) - self.path.rest).max() <= _AT_REST)

    def has_passed(self, command: ArmCommand) -> bool:
        """Whether an answer was for a time of the command's already, and followed the stop before it."""
        return self.state.following and self.state.answered > command.start

    def follow(self, command: ArmCommand) -> None:
        """Take a tick's command, which no answer has passed."""
        state = self.state
        if state.is_silent(command.now):
            self._brake()
        if not state.following and self._begins(command):
            state.following = state.fault(command.now) is None
            self.path = ReferencePath(command.start, self.path.rest)
        if state.following and command.end > self.path.end:  # a second command in a tick is no motion
            there, speed, deceleration = map(np.array, (command.q, command.v, command.deceleration))
            self.path.extend(command.end, there, speed, deceleration, command.start)
            state.rest = joints_of(self.path.rest)
        self._outputs |= command.outputs
        if command.damping is not None:
            self._tau = None if command.tau is None else np.array(command.tau)
            self._damping, self._tau_came = np.array(command.damping), command.now

    def _begins(self, command: ArmCommand) -> bool:
        """Whether the reference was at rest a tick ago, where the arm is."""
        state, step = self.state, command.end - command.start
        torques = state.wanted is CommandKind.TORQUE and state.newest
        if not torques and not self._rests(state.answered):
            return False
        there, allowed = (torques.q, _NEAR) if torques else (self.path.rest, _SAME)
        way, speed = np.abs(np.subtract(command.q, there)), np.abs(command.v)
        return bool((speed <= _FROM_REST * step).all() and (way <= speed * step + allowed).all())

    def answer(self, datagram: bytes, now: float) -> bytes | None:
        """Take a message that came at ``now`` [s]; returns the datagram that answers it, if one is due."""
        try:
            message = read_monitoring(datagram)
            self._check(message, now)
        except ProtocolError as error:
            self.state.unreadable, self.state.problem = self.state.unreadable + 1, str(error)
            return None
        if not self._take(message, now) or message.counter % message.multiplier:
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
        before, passed = self.state.newest, now - self.state.arrival
        if before is None or self.state.is_silent(now):
            return
        if message.version != before.version:
            raise ProtocolError(f"FRI {message.version} amid messages of FRI {before.version}")
        ahead = _ahead(message, before)
        if ahead > 2.0 * passed / message.period + _MOST_AHEAD:
            raise ProtocolError(f"FRI message counter {ahead} ahead, {passed:.3f} s after the last one")

    def _take(self, message: Monitoring, now: float) -> bool:
        """Note a message; False for one that is older than the newest."""
        state, before = self.state, self.state.newest
        state.problem = None
        if before is None or state.is_silent(now):
            passed = 0
            if before is not None and self._lasts(message, before):
                self._brake()  # to begin anew would stop the arm at once
            else:
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
            self._clock = MessageClock(now)
        elif passed == 0 and (before is None or message.counter != before.counter):
            self._clock = MessageClock(now)
        elif passed > 0:
            self._clock.update(now, passed * message.period)
        if passed > 0 and before is not None:
            state.lost += passed - 1
            time = passed * message.period
            moved = zip(state.velocity, message.q, before.q, self._velocity_limit, strict=True)
            state.velocity = tuple(
                0.5 * (v + min(max((now_at - was_at) / time, -limit), limit)) for v, now_at, was_at, limit in moved
            )
        elif passed == 0 and before is not None and message.counter != before.counter:
            state.velocity = (0.0,) * JOINTS
        state.newest, state.arrival = message, now
        return True

    def _lasts(self, message: Monitoring, before: Monitoring) -> bool:
        """Whether the session before a silence goes on after it."""
        active = Session.COMMANDING_ACTIVE
        same = message.version == before.version and message.session is before.session is active
        return self._begun and same and _ahead(message, before) > 0

    def _brake(self) -> None:
        """The cabinet is silent: the arm follows no more, and brakes from where the newest answer led it."""
        if self.state.following:
            self._cease()
            if self.state.wanted is CommandKind.POSITION:
                self.path.brake(self.state.answered)
                self.state.rest = joints_of(self.path.rest)

    def _begin_anew(self) -> None:
        """The arm is where its cabinet says next."""
        self._cease()
        self._begun = False
        self._times = None
        self._tau_sent = np.zeros(JOINTS)

    def _cease(self) -> None:
        self.state.ended += self.state.following
        self.state.following = False

    def _command(self, message: Monitoring, now: float) -> FriCommand | None:
        counter, reflected = self._answers, message.counter
        if message.session < Session.COMMANDING_WAIT:
            self._begin_anew()
            if message.session is Session.IDLE:
                return None
            mirrored = message.commanded_q or message.q  # which FRI 1 expects, and FRI 2 does without
            return FriCommand(counter, reflected, mirrored if message.version == 1 else None, io=self._io(message))
        if self._times is None:
            self._times = AnswerTimes(message.period * message.multiplier, DELAY)
        if message.session is Session.COMMANDING_WAIT or not self._begun:
            # The first command has to equal the cabinet's own position, and the reference begins there. In a session
            # that another client has begun, the arm is no longer where the cabinet's own motion holds it.
            own = message.ipo_q if message.session is Session.COMMANDING_WAIT else message.commanded_q
            self._cease()
            self._begun = True
            self.path = ReferencePath(now, np.array(own or message.q))
            self.state.rest = joints_of(self.path.rest)
            self._times.restart()
        if self.state.wanted is CommandKind.TORQUE:
            return self._torque(message, now)
        question = message.counter, self._clock.expected - self.waits, counter, message.reflected
        time, state = self._times.at(*question), self.state
        wanted = self._clock.expected - self.waits - DELAY
        if abs(wanted - time) > message.period and self._rests(min(time, wanted)):
            self._times.restart()  # where nothing moves, and nothing is known that will, an answer may be for any time
            time = self._times.at(*question)
        state.answered, state.lag = max(state.answered, time), now - DELAY - time
        state.expected, state.behind = self._clock.expected, self._clock.expected - DELAY - time
        return FriCommand(counter, reflected, joints_of(self.path.at(time)), io=self._io(message))

    def _io(self, message: Monitoring) -> dict[str, IoValue]:
        """Values for the outputs that the cabinet has; others are not written."""
        fitting = {name: message.output(name, value) for name, value in self._outputs.items()}
        return {name: value for name, value in fitting.items() if value is not None}

    def _torque(self, message: Monitoring, now: float) -> FriCommand | None:
        """The newest overlay, or one that brakes, with the cabinet's own position as KUKA's example clients have it."""
        age = now - self._tau_came
        if self.state.is_too_slow or (message.session is Session.COMMANDING_ACTIVE and age > _TORQUE_GONE):
            return None
        wanted = self._tau
        if wanted is None or not self.state.following or age > _TORQUE_LASTS:
            wanted = -self._damping * np.array(self.state.velocity)
        change = self._torque_rate_limit * self.state.period
        tau = np.clip(wanted, -self._torque_limit, self._torque_limit)
        self._tau_sent = np.clip(tau, self._tau_sent - change, self._tau_sent + change)
        q = message.ipo_q or message.q
        return FriCommand(self._answers, message.counter, q, joints_of(self._tau_sent), self._io(message))


def follow(sessions: Mapping[str, ArmSession], commands: Mapping[str, ArmCommand]) -> bool:
    """Let every arm take its command, or none where one of them came too late: both brake together."""
    if any(sessions[arm].has_passed(command) for arm, command in commands.items()):
        return False
    for arm, command in commands.items():
        sessions[arm].follow(command)
    return True


def answer(sessions: Mapping[str, ArmSession], arm: str, datagram: bytes, now: float) -> bytes | None:
    """As :meth:`ArmSession.answer` of one ``arm``, which waits for those that are behind.

    It waits by half of what they are behind. They catch up meanwhile, and so all arrive where none is behind.
    """
    lags = [other.state.timing(now).lag for name, other in sessions.items() if name != arm and other.state.following]
    sessions[arm].waits = 0.5 * max(0.0, *lags, 0.0)
    return sessions[arm].answer(datagram, now)


def _ahead(message: Monitoring, before: Monitoring) -> int:
    """By how many messages it is newer; negative: older."""
    return (message.counter - before.counter + _COUNTERS // 2) % _COUNTERS - _COUNTERS // 2
