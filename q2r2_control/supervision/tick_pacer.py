"""A late tick is no jump: by how much time the reference may move in one tick, and how far a pose.

A plant takes one command a period: a joint may do what its velocity limit allows in one period, however late the
command comes. A tick that is late moves the reference by the time t that passed, but no joint by more than its limit V
allows in a period h. That is  |v| t + a t^2 / 2 <= V h  for each joint, with the acceleration limit a. Else it moves by
one period, which no joint's limit forbids. Slow motion catches up at once, and fast motion is stretched in time: the
same path, later. A command that is clipped joint by joint would leave the path that was certified.

A plant that is told a velocity goes on at it while no command comes (``coasts``). Then the reference goes on too, by
the time that passed, up to 0.1 s; what is commanded stays within the velocity limit.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.types import LONGEST_DT, Array

_ROUNDING = 1e-9  # of a period


class TickPacer:
    """Turns the time since the last tick into the time that the reference moves by, and counts what was late."""

    def __init__(self, period: float, velocity_limit: Array, acceleration_limit: Array, coasts: bool = False) -> None:
        """``period`` [s] of the commands; ``velocity_limit`` [rad/s], ``acceleration_limit`` [rad/s^2], (n,) each."""
        self.period = period
        self.missed_ticks = 0  # commands that were due and did not come
        self.stretched = 0.0  # time by which the motion is late for it [s]
        self._way = velocity_limit * period  # in one period [rad]
        self._acceleration = acceleration_limit
        self._coasts = coasts

    def step(self, gap: float, v: Array) -> float:
        """Time [s] to move by, at most the ``gap`` [s] since the last tick, from velocities ``v`` (nv,) [rad/s]."""
        if not gap > self.period * (1.0 + _ROUNDING):
            return gap if gap > 0.0 else 0.0
        # Half a period late is jitter; from there on a command is missing.
        self.missed_ticks += max(round(gap / self.period) - 1, 0)
        # The time in which each joint can have used up its way.
        longest = 2.0 * self._way / (np.abs(v) + np.sqrt(v * v + 2.0 * self._acceleration * self._way))
        step = min(gap, LONGEST_DT if self._coasts else max(self.period, float(longest.min())))
        self.stretched += gap - step
        return step


_SHARE = 0.02  # of what the even time is off is made up in a tick


class TickClock:
    """Turns the times at which ticks ran into the times for which they count, all in [s]."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._last = -math.inf

    def at(self, now: float) -> float:
        """The time for which a tick at ``now`` counts; time begins anew after over 0.1 s, and where it was set back."""
        off = now - self._last - self._period
        if not -2.0 * self._period < off < LONGEST_DT:
            self._last = now
            return now
        missed = round(off / self._period)
        if missed >= 0:
            self._last += (1 + missed) * self._period + _SHARE * (off - missed * self._period)
        return self._last


_REST = 1e-9  # slower than this is at rest [m/s, rad/s]


class PoseRateLimiter:
    """Follows a target within limits of velocity and acceleration, and comes to rest where there is none.

    Within the limits a target that moves steadily is followed without lag. The limit is on the speed relative to it, v
    = u + e/|e| s(|e|), with u the target's own velocity, and e the lag. s is the largest speed from which full braking
    in steps of dt still stops at it,

        s(d) = min(d / dt, a (-dt/2 + sqrt(dt^2/4 + 2 d/a))).

    A step of the target faster than the limit is no motion of it; then u = 0. Rotations are limited the same way by
    the rotation vector from pose to target. All poses are in one frame. A step that comes late moves the pose no
    farther than the velocity limits allow in one period, see :class:`TickPacer`. After a gap of more than 0.1 s it
    begins from rest: the follower stands at the last pose.
    """

    def __init__(self, settings: GuardSettings, period: float) -> None:
        """``period`` [s]: of the steps."""
        self.pose: pin.SE3 | None = None
        self.clipped = 0  # steps in which a limit held the pose back, since the start
        self._linear, self._angular = _Limited(), _Limited()
        self._target: pin.SE3 | None = None
        self._now, self._period = -math.inf, period
        self.change(settings)

    def change(self, settings: GuardSettings) -> None:
        """Other limits from the next step on. A pose that is faster than it may be now brakes at the acceleration."""
        self.settings = settings
        self._linear.limits = settings.max_velocity, settings.max_acceleration
        self._angular.limits = settings.max_angular_velocity, settings.max_angular_acceleration
        # A step changes the velocity first and moves by the new one for all of dt: |v| dt + a dt^2, not half of that.
        velocities, accelerations = np.array([self._linear.limits, self._angular.limits]).T
        self._pacer = TickPacer(self._period, velocities, 2.0 * accelerations)

    @property
    def at_rest(self) -> bool:
        """Whether the pose stands still, which it also does when there is none."""
        return self.pose is None or (self._linear.speed < _REST and self._angular.speed < _REST)

    def reset(self, pose: pin.SE3 | None, now: float) -> None:
        """Rest at ``pose``, or at none, from ``now`` [s] on."""
        self.pose, self._target, self._now = pose, None, now
        self._linear.velocity = self._angular.velocity = np.zeros(3)

    def step(self, target: pin.SE3 | None, now: float) -> pin.SE3 | None:
        """The pose at ``now`` [s], nearer to ``target``; None or a target that is not finite: brake and hold.

        None before the first :meth:`reset`. A time that does not advance returns the same pose again.
        """
        gap = now - self._now
        if self.pose is None or not gap > 0.0:
            return self.pose
        if gap > LONGEST_DT:  # whatever follows has come to rest meanwhile, or is about to
            self._linear.velocity = self._angular.velocity = np.zeros(3)
        dt = gap
        if gap > self._period:
            dt = self._pacer.step(gap, np.array([self._linear.speed, self._angular.speed]))
        self._now = now
        at = self.pose
        if target is None or not np.isfinite(target.homogeneous).all():
            self._target, limited = None, False
            shift, turn = (motion.towards(np.zeros(3), dt)[0] for motion in (self._linear, self._angular))
        else:
            last, self._target = self._target or at, target
            # Of a late step only the part that is moved now counts as the target's own motion; the rest is lag.
            share = dt / gap
            lag, way = last.translation - at.translation, target.translation - last.translation
            shift, slow = self._linear.follow(lag + (1.0 - share) * way, share * way, dt)
            lag, way = pin.log3(last.rotation @ at.rotation.T), pin.log3(target.rotation @ last.rotation.T)
            turn, slow_turn = self._angular.follow(lag + (1.0 - share) * way, share * way, dt)
            limited = slow or slow_turn
        self.clipped += limited
        rotation = pin.Quaternion(pin.exp3(turn) @ at.rotation).normalized()
        self.pose = pin.SE3(rotation, at.translation + shift)
        return self.pose


class _Limited:
    """Velocity of a position or a rotation that is bounded together with its change."""

    def __init__(self) -> None:
        self.limits = 0.0, 0.0  # of velocity and acceleration
        self.velocity = np.zeros(3)

    @property
    def speed(self) -> float:
        return math.hypot(*self.velocity)

    def follow(self, lag: Array, way: Array, dt: float) -> tuple[Array, bool]:
        """The step in ``dt`` [s], ``lag`` behind a target that goes ``way``; whether it is less than asked for."""
        own, (fastest, a) = way / dt, self.limits
        if math.hypot(*own) > fastest:
            lag, own = lag + way, np.zeros(3)
        distance, wanted = math.hypot(*lag), own
        if distance > 0.0:
            speed = min(distance / dt, a * (-0.5 * dt + math.sqrt(0.25 * dt * dt + 2.0 * distance / a)))
            wanted = own + (speed / distance) * lag
        shift, limited = self.towards(wanted, dt)
        return shift, limited or distance > fastest * dt

    def towards(self, wanted: Array, dt: float) -> tuple[Array, bool]:
        """The step in ``dt`` [s] on the way to a ``wanted`` velocity, and whether that is not reached."""
        fastest, acceleration = self.limits
        change = _at_most(wanted, fastest) - self.velocity
        self.velocity = self.velocity + _at_most(change, acceleration * dt)
        return self.velocity * dt, math.dist(self.velocity, wanted) > _REST


def _at_most(vector: Array, length: float) -> Array:
    norm = math.hypot(*vector)
    return vector if norm <= length else vector * (length / norm)
