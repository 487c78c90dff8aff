"""The session with one robot: it computes the command that answers each state. The caller passes the time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from q2r2_control import Array, CommandMode
from q2r2_control.plants import ReferencePath
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.state import ArmCommand, Joints, Measured, SessionState
from q2r2_franka.stream import PositionStream, TorqueStream

_AT_REST = 1e-9  # Greatest distance from the end of the path at which the arm counts as resting [rad].
_STILL = 0.02  # In torque mode, an arm counts as resting if all joints are slower than this [rad/s].
# An arm may begin to follow a reference if each joint is nearer to it than this [rad]. In position mode, the positions
# that the robot holds have to be within the first number. In torque mode, the measured positions have to be within the
# second number.
_SAME, _NEAR = 1e-6, 0.02
# No joint has a greater acceleration in the first tick after rest [rad/s^2]. If a joint of the reference is faster than
# this acceleration allows after one tick, the reference was not at rest one tick ago.
_FROM_REST = 20.0
_TORQUE_LASTS = 0.02  # If the commanded torque is older than this, a torque that brakes the arm replaces it [s].
_BRAKES = 1.0  # In torque mode, an arm is braked for at most this time. Then its robot holds it [s].
# If one arm is ahead of the other arm on the reference, the time of this arm passes more slowly. The share by which it
# passes more slowly is at most _WAITING, and changes by at most _WAITING_RAMP in a second [1/s]. So the robot's
# acceleration is at most a + _WAITING_RAMP v, where a and v are the acceleration and velocity of the reference. The
# wanted share is _WAITING_GAIN [1/s] times the time by which the arm is ahead.
_WAITING, _WAITING_RAMP, _WAITING_GAIN = 0.1, 0.4, 10.0
_MOST_CYCLES = 100  # If more periods than this are lost, the robot has surely ended the motion itself.


class ArmSession:
    """The session of one arm.

    The commands of the arm lie on ``path``. While the arm follows the reference, each tick extends the path. Otherwise
    the path ends with a stop, and the arm is held at the end of the path.
    """

    def __init__(self, arm: str, address: str, wanted: CommandMode, torque_limit: Array) -> None:
        """Make the session of one arm without commands. ``torque_limit`` is each joint's greatest torque (7,) [Nm]."""
        self.state, self._torque_limit = SessionState(arm, address, wanted), torque_limit
        self._tau: Array | None = None
        self._tau_came = self._ceased = -math.inf
        self._damping = np.zeros(JOINTS)
        self.begin(np.zeros(JOINTS), 0.0)
        self.state.controlled = False

    def begin(self, q: Array, now: float) -> None:
        """Let commands begin at ``now`` [s]. At this time, the robot holds the arm at ``q`` (7,) [rad]."""
        self.path, self._positions = ReferencePath(now, q), PositionStream(q)
        self._torques = TorqueStream(self._torque_limit)
        self._rate, self._tau = 1.0, None
        self._ceased = -math.inf
        state = self.state
        state.controlled, state.following, state.answered, state.behind = True, False, now, 0.0
        state.rest = tuple(map(float, q))

    def end(self, problem: str) -> None:
        """Store that commands no longer move the arm. ``problem`` says why."""
        self.state.ended += self.state.following
        self.state.controlled = self.state.following = False
        self.state.problem = problem

    def brake(self, now: float) -> None:
        """Let the arm brake from ``now`` [s] on: along its certified stop, or by a damping in torque mode."""
        if self.state.following:
            self.state.following, self._ceased = False, now
            self.path.brake(self.state.answered)
            self.state.rest = tuple(map(float, self.path.rest))

    def is_still(self, now: float) -> bool:
        """Return whether the arm counts as resting at ``now`` [s], and stays at rest if no more commands come."""
        if not self.state.controlled or self.state.is_silent(now):
            return True
        if self.state.wanted is CommandMode.TORQUE:
            newest = self.state.newest
            rests = newest is not None and max(map(abs, newest.v)) < _STILL
            return not self.state.following and (rests or now - self._ceased > _BRAKES)
        return not self.state.following and self._rests(self.state.answered)

    def _rests(self, t: float) -> bool:
        """Return whether the arm has reached the end of its path at ``t`` [s]."""
        return bool(np.abs(self.path.at(t) - self.path.rest).max() <= _AT_REST)

    def has_passed(self, command: ArmCommand) -> bool:
        """Return whether ``command`` has come too late.

        It has come too late if the robot already got a position for a time after the start of ``command``. The robot is
        then already on the stop of the previous command.
        """
        return self.state.following and self.state.answered > command.start

    def follow(self, command: ArmCommand) -> None:
        """Take the command of a tick, for which :meth:`has_passed` is False."""
        state = self.state
        if not state.following and state.controlled and self._begins(command):
            state.following = state.fault(command.now) is None
            self.path = ReferencePath(command.start, self.path.rest)
        if state.following and command.end > self.path.end:
            there, speed, deceleration = map(np.array, (command.q, command.v, command.deceleration))
            self.path.extend(command.end, there, speed, deceleration, command.start)
            state.rest = tuple(map(float, self.path.rest))
        if command.damping is not None:
            self._tau = None if command.tau is None else np.array(command.tau)
            self._damping, self._tau_came = np.array(command.damping), command.now

    def _begins(self, command: ArmCommand) -> bool:
        """Return whether the reference was at rest one tick ago, at the position of the arm."""
        state, step = self.state, command.end - command.start
        has_torques = state.wanted is CommandMode.TORQUE and state.newest is not None
        if not has_torques and not self._rests(state.answered):
            return False
        there: Joints | Array = state.newest.q if has_torques and state.newest is not None else self.path.rest
        allowed = _NEAR if has_torques else _SAME
        way, speed = np.abs(np.subtract(command.q, there)), np.abs(command.v)
        return bool((speed <= _FROM_REST * step).all() and (way <= speed * step + allowed).all())

    def hear(self, measured: Measured, now: float) -> None:
        """Store a state of the robot that came at ``now`` [s]."""
        self.state.hear(measured, now)

    def answer(self, now: float, ahead: float) -> Array:
        """Return the command that answers the newest state: positions (7,) [rad] or torques (7,) [Nm].

        Args:
            now: The time by the monotonic clock [s].
            ahead: Time by which this arm is ahead of the other arm on the reference [s].
        """
        state = self.state
        assert state.newest is not None
        cycles = min(max(state.newest.cycles, 1), _MOST_CYCLES)
        state.lost += cycles - 1
        wanted = 1.0 - min(max(_WAITING_GAIN * ahead, 0.0), _WAITING)
        rests = not state.following and self._rests(state.answered)
        path = []
        for _ in range(cycles):
            ramp = _WAITING_RAMP * PERIOD
            self._rate = min(max(wanted, self._rate - ramp), self._rate + ramp)
            state.answered = max(state.answered, now) if rests else state.answered + self._rate * PERIOD
            path.append(self.path.at(state.answered))
        if state.wanted is CommandMode.POSITION:
            return self._positions.next(path, np.array(state.newest.held))
        tau = self._tau
        if tau is None or not state.following or now - self._tau_came > _TORQUE_LASTS:
            tau = -self._damping * np.array(state.newest.v)
        return self._torques.next(tau, np.array(state.newest.held_tau))


def follow(sessions: Mapping[str, ArmSession], commands: Mapping[str, ArmCommand]) -> bool:
    """Let every arm take its command, and return True.

    If at least one of the commands came too late, no arm takes its command, and the result is False.
    """
    if any(sessions[arm].has_passed(command) for arm, command in commands.items()):
        return False
    for arm, command in commands.items():
        sessions[arm].follow(command)
    return True


def ahead_of_others(sessions: Mapping[str, ArmSession], arm: str, now: float) -> float:
    """Return the time by which an arm is ahead of the other arm on the reference [s]; 0 if it is not ahead.

    Only arms that follow the reference count. If there were several other arms, the hindmost would count. Also store in
    the arm's state the time by which the arm is behind the other arm, or behind the foremost of several others [s].
    """
    state = sessions[arm].state
    others = [session.state for name, session in sessions.items() if name != arm and session.state.following]
    if not state.following or not others:
        state.behind = 0.0
        return 0.0
    # After an arm's newest state, its time on the reference is assumed to go on for at most one period.
    times = [other.answered + min(max(now - other.arrival, 0.0), PERIOD) for other in others]
    own = state.answered + min(now - state.arrival, PERIOD)
    state.behind = max(max(times) - own, 0.0)
    return max(own - min(times), 0.0)
