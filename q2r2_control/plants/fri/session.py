"""Keep the session with one cabinet: a datagram goes in, and its answer comes out. The caller passes the time in."""

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

# An answer is for a time that is this much earlier than the arrival of its question [s]. Even on a busy computer, the
# loop has computed the reference for that time before the question arrives.
DELAY = 0.004
_AT_REST = 1e-9  # Greatest distance from the end of the path at which the arm counts as resting [rad].
_RESTARTED = 1000  # If a message's counter goes back by more than this, the session has begun again.
_COUNTERS = 1 << 32
# A message's counter may have grown by at most twice the number of periods that have passed, plus this number.
_MOST_AHEAD = 20
# A torque without updates would push for ever. If it is older than the first of these times [s], it is replaced by a
# torque that brakes. If it is older than the second time [s], the cabinet gets no answer, so that it ends the session.
_TORQUE_LASTS, _TORQUE_GONE = 0.02, 0.1
# Least limit of the torques' rate [Nm/s]. A lower limit is raised to this value, because the damping would otherwise
# come too late.
_BRAKING_RATE = 5000.0
# Greatest distance at which a reference may begin [rad]: with positions, from the position in which the arm is held;
# with torques, from the arm's measured position.
_SAME, _NEAR = 1e-6, 0.02
_FROM_REST = 20.0  # Upper bound on the acceleration of a joint in the first tick from rest [rad/s^2].


class ArmSession:
    """The session of one arm.

    While the arm follows the reference, the positions in its answers lie on ``path``. At all other times, the positions
    keep the arm at rest.
    """

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
        """Make the session of one arm.

        Args:
            arm: The arm.
            source: The cabinet's address and port in words.
            wanted: The kind of commands, positions or torques.
            version: The version of FRI that is allowed, 1 or 2; None if both are.
            torque_limit: Greatest torque of an overlay (n,) [Nm].
            velocity_limit: Greatest plausible measured velocity (n,) [rad/s]. Faster measurements are clipped. If a
                measured position jumps once, the damping then pushes the joint back by at most the distance that it
                moves in one period at this velocity.
            torque_rate_limit: Greatest rate of a torque between two answers [Nm/s]. A limit below 5000 Nm/s is raised
                to 5000 Nm/s, so that the damping comes in time.
        """
        self.state, self._version = SessionState(arm, source, wanted), version
        self.path = ReferencePath(0.0, np.zeros(JOINTS))
        # The torque overlay [Nm], or None if the damping brakes; and the time of the tick that computed it [s].
        self._tau: Array | None = None
        self._tau_came = -math.inf
        self._damping = np.zeros(JOINTS)  # The damping that brakes the arm if no overlay comes [Nm s/rad].
        none = np.full(JOINTS, math.inf)
        self._torque_limit = none if torque_limit is None else torque_limit
        self._torque_rate_limit = max(torque_rate_limit, _BRAKING_RATE)
        self._tau_sent = np.zeros(JOINTS)
        self._velocity_limit = joints_of(none if velocity_limit is None else velocity_limit)
        self._outputs: dict[str, IoValue] = {}
        self._answers = 0
        self._times: AnswerTimes | None = None
        self._clock = MessageClock(-math.inf)
        # The times of answers are this much earlier, so that the arm waits for other arms that are behind [s].
        self.waits = 0.0
        self._begun = False  # Whether the path begins at the cabinet's own position, which is then known.

    def is_still(self, now: float) -> bool:
        """Return whether nothing moves the arm at ``now`` [s] if no more commands come."""
        if not self._begun or self.state.is_silent(now):
            return True
        if self.state.wanted is CommandKind.TORQUE:
            return not self.state.following or now - self._tau_came > _TORQUE_GONE
        return self._rests(self.state.answered)

    def _rests(self, t: float) -> bool:
        """Return whether the path has come to its end at ``t`` [s]."""
        return bool(np.abs(self.path.at(t) - self.path.rest).max() <= _AT_REST)

    def has_passed(self, command: ArmCommand) -> bool:
        """Return whether an answer was already sent for a time after the start of ``command``.

        That answer lay on the earlier stop, so that the command has come too late.
        """
        return self.state.following and self.state.answered > command.start

    def follow(self, command: ArmCommand) -> None:
        """Take the command of a tick, for which :meth:`has_passed` is False."""
        state = self.state
        if state.is_silent(command.now):
            self._brake()
        if not state.following and self._begins(command):
            state.following = state.fault(command.now) is None
            self.path = ReferencePath(command.start, self.path.rest)
        if state.following and command.end > self.path.end:  # A second command of one tick adds no motion.
            there, speed, deceleration = map(np.array, (command.q, command.v, command.deceleration))
            self.path.extend(command.end, there, speed, deceleration, command.start)
            state.rest = joints_of(self.path.rest)
        self._outputs |= command.outputs
        if command.damping is not None:
            self._tau = None if command.tau is None else np.array(command.tau)
            self._damping, self._tau_came = np.array(command.damping), command.now

    def _begins(self, command: ArmCommand) -> bool:
        """Return whether the arm can begin to follow with ``command`` without a jump.

        This is so if the reference can have been at rest one tick ago, at the arm's position. With torques, this is the
        measured position. Otherwise it is the end of the path, which the arm must have reached.
        """
        state, step = self.state, command.end - command.start
        torques = state.wanted is CommandKind.TORQUE and state.newest
        if not torques and not self._rests(state.answered):
            return False
        there, allowed = (torques.q, _NEAR) if torques else (self.path.rest, _SAME)
        distance, speed = np.abs(np.subtract(command.q, there)), np.abs(command.v)
        return bool((speed <= _FROM_REST * step).all() and (distance <= speed * step + allowed).all())

    def answer(self, datagram: bytes, now: float) -> bytes | None:
        """Take a message that came at ``now`` [s]; returns the answer's datagram, or None if it gets no answer."""
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
        """Raise :class:`ProtocolError` if a message cannot come from this cabinet."""
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
        """Take the contents of a message; returns False if it is older than the newest one."""
        state, before = self.state, self.state.newest
        state.problem = None
        if before is None or state.is_silent(now):
            passed = 0
            if before is not None and self._lasts(message, before):
                # The arm brakes on its path, because it would stop abruptly if the session began anew here.
                self._brake()
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
        """Return whether ``message`` shows that the session of ``before`` goes on after a silence."""
        active = Session.COMMANDING_ACTIVE
        same = message.version == before.version and message.session is before.session is active
        return self._begun and same and _ahead(message, before) > 0

    def _brake(self) -> None:
        """Let the arm brake from the newest answer, because its cabinet was silent."""
        if self.state.following:
            self._cease()
            if self.state.wanted is CommandKind.POSITION:
                self.path.brake(self.state.answered)
                self.state.rest = joints_of(self.path.rest)

    def _begin_anew(self) -> None:
        """Let the path begin again, at the position in the cabinet's next message."""
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
            mirrored = message.commanded_q or message.q  # FRI 1 expects these positions; FRI 2 does not need them.
            return FriCommand(counter, reflected, mirrored if message.version == 1 else None, io=self._io(message))
        if self._times is None:
            self._times = AnswerTimes(message.period * message.multiplier, DELAY)
        if message.session is Session.COMMANDING_WAIT or not self._begun:
            # The first command has to equal the cabinet's own position, at which the reference begins. If another
            # client has begun the session, the arm has left that position. The reference then begins at the position
            # that the cabinet reports as commanded.
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
            # While nothing moves, an answer may be for any time. The times of answers can therefore begin anew.
            self._times.restart()
            time = self._times.at(*question)
        state.answered, state.lag = max(state.answered, time), now - DELAY - time
        state.expected, state.behind = self._clock.expected, self._clock.expected - DELAY - time
        return FriCommand(counter, reflected, joints_of(self.path.at(time)), io=self._io(message))

    def _io(self, message: Monitoring) -> dict[str, IoValue]:
        """Return the values for the outputs that the cabinet has. Other outputs are not written."""
        fitting = {name: message.output(name, value) for name, value in self._outputs.items()}
        return {name: value for name, value in fitting.items() if value is not None}

    def _torque(self, message: Monitoring, now: float) -> FriCommand | None:
        """Return an answer with the newest torque overlay, or with an overlay that brakes; None for no answer.

        The answer repeats the cabinet's own position, as in KUKA's examples.
        """
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
    """Let every arm take its command, and return True.

    If a command came too late, no arm takes its command, and False is returned. The arms then follow the certified stop
    of the previous command.
    """
    if any(sessions[arm].has_passed(command) for arm, command in commands.items()):
        return False
    for arm, command in commands.items():
        sessions[arm].follow(command)
    return True


def answer(sessions: Mapping[str, ArmSession], arm: str, datagram: bytes, now: float) -> bytes | None:
    """Answer a cabinet's message as :meth:`ArmSession.answer` does, and let its arm wait for arms that are behind.

    The wait is half the largest lag of the other arms. The other arms catch up meanwhile, until no arm is behind.
    """
    lags = [other.state.timing(now).lag for name, other in sessions.items() if name != arm and other.state.following]
    sessions[arm].waits = 0.5 * max(0.0, *lags, 0.0)
    return sessions[arm].answer(datagram, now)


def _ahead(message: Monitoring, before: Monitoring) -> int:
    """Return the number of messages by which ``message`` is newer than ``before``; negative if it is older."""
    return (message.counter - before.counter + _COUNTERS // 2) % _COUNTERS - _COUNTERS // 2
