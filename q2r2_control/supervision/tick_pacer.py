"""Keep a late tick from causing a jump: bound the time by which a tick advances the reference.

A plant takes one command per period. From one command to the next a joint may move as far as its velocity limit allows
in one period, even if the command comes late. A late tick therefore moves the reference by the time t that has passed
if no joint then moves farther than its velocity limit V allows in a period h:  |v| t + a t^2 / 2 <= V h  for each
joint, with its acceleration limit a. Otherwise t is reduced until this is true, but not below one period. A slow motion
therefore makes up for the whole delay in one tick. A fast motion follows the same path, but later. If each joint of a
command were clipped on its own, the command would leave the path that was certified.

A plant that takes velocity commands keeps moving at the last velocity while no command comes (``coasts``). Then the
reference also advances by the time that has passed, up to 0.1 s. The commanded velocity stays within its limit.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.types import LONGEST_DT, Array

_FORGETTING = 0.98  # At each tick, the sum of earlier delays is multiplied by this factor.
_ROUNDING = 1e-9  # The time before a punctual tick may exceed the period by this share of the period.


class MissedTicks:
    """Counts the ticks that were due and never came. A tick that only came late is not missed.

    A tick that is late by more than half a period counts as missed at first. If the next tick comes so early that the
    ticks are on their grid again, the tick is no longer counted as missed.
    """

    def __init__(self) -> None:
        self.count = 0
        self._behind = 0.0  # How far the ticks are behind their grid, if missed ticks do not count [periods].

    def add(self, gap: float) -> None:
        """Take the time between two ticks [periods]."""
        self._behind += gap - 1.0
        missed = max(round(self._behind), -self.count)
        self.count += missed
        # Earlier delays are forgotten slowly. Without this, ticks would seem missed after some time if two clocks run
        # at different rates.
        self._behind = _FORGETTING * max(self._behind - missed, -0.5)


class TickPacer:
    """Computes the time by which the reference advances in a tick, and counts late ticks."""

    def __init__(self, period: float, velocity_limit: Array, acceleration_limit: Array, coasts: bool = False) -> None:
        """Make a pacer.

        Args:
            period: Time between two commands [s].
            velocity_limit: Velocity limit of each joint (n,) [rad/s].
            acceleration_limit: Acceleration limit of each joint (n,) [rad/s^2].
            coasts: Whether the plant goes on at the last velocity while no command comes.
        """
        self.period = period
        self._missed = MissedTicks()
        self.stretched = 0.0  # Time by which the motion is late because of late ticks [s].
        self._travel = velocity_limit * period  # The farthest that each joint may move in one period (n,) [rad].
        self._acceleration = acceleration_limit
        self._coasts = coasts

    @property
    def missed_ticks(self) -> int:
        """The number of commands that were due and were not sent."""
        return self._missed.count

    def step(self, gap: float, v: Array) -> float:
        """Return the time by which the reference advances [s], at most ``gap``.

        Args:
            gap: Time since the last tick [s].
            v: Present joint velocities of the reference (n,) [rad/s].
        """
        if not gap > 0.0:
            return 0.0
        self._missed.add(gap / self.period)
        if not gap > self.period * (1.0 + _ROUNDING):
            return gap
        # For each joint, the time in which it can move at most as far as one period permits.
        longest = 2.0 * self._travel / (np.abs(v) + np.sqrt(v * v + 2.0 * self._acceleration * self._travel))
        step = min(gap, LONGEST_DT if self._coasts else max(self.period, float(longest.min())))
        self.stretched += gap - step
        return step


_CORRECTION = 0.02  # Share of the difference between even time and measured time that one tick corrects.


class TickClock:
    """Turns the times at which ticks ran, which jitter, into evenly spaced times [s]."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._last = -math.inf

    def at(self, now: float) -> float:
        """Return the even time of a tick that runs at ``now`` [s].

        The even times begin again after a gap of more than 0.1 s, and after a clock that was set back.
        """
        off = now - self._last - self._period
        if not -2.0 * self._period < off < LONGEST_DT:
            self._last = now
            return now
        missed = round(off / self._period)
        if missed >= 0:
            self._last += (1 + missed) * self._period + _CORRECTION * (off - missed * self._period)
        return self._last


_REST = 1e-9  # A pose that is slower than this is at rest [m/s, rad/s].


class PoseRateLimiter:
    """Follows a target within limits of velocity and acceleration, and brakes to rest if there is no target.

    A target that moves steadily within the limits is followed without lag. The velocity is v = u + e/|e| s(|e|), where
    u is the target's own velocity and e the vector from the pose to the target. s is the greatest speed from which full
    braking in steps of dt still stops at the target,

        s(d) = min(d / dt, a (-dt/2 + sqrt(dt^2/4 + 2 d/a))).

    If the target moves faster than the limit, it has jumped, and u is 0. Rotations are limited in the same way, by
    the rotation vector from pose to target. All poses are in one frame. A late step moves the pose no farther than the
    velocity limits allow in one period, see :class:`TickPacer`. After a gap of more than 0.1 s the motion begins from
    rest, because whatever follows the pose has come to rest at the last pose.
    """

    def __init__(self, settings: GuardSettings, period: float) -> None:
        """``period`` is the time between two steps [s]."""
        self.clipped = 0  # Number of steps since the start in which a limit has slowed the pose.
        self._linear, self._angular, self._period = _Limited(), _Limited(), period
        self.change(settings)
        self.reset(None, -math.inf)

    def change(self, settings: GuardSettings) -> None:
        """Change the limits from the next step on. A pose that is too fast then brakes at the acceleration limit."""
        self.settings = settings
        self._linear.limits = settings.max_velocity, settings.max_acceleration
        self._angular.limits = settings.max_angular_velocity, settings.max_angular_acceleration
        # A step changes the velocity first, and then moves at the new velocity for all of dt. The acceleration thus
        # adds the distance a dt^2, not half of that. For this reason the pacer gets twice the acceleration.
        velocities, accelerations = np.array([self._linear.limits, self._angular.limits]).T
        self._pacer = TickPacer(self._period, velocities, 2.0 * accelerations)

    @property
    def at_rest(self) -> bool:
        """Whether the pose stands still; True if there is no pose."""
        return self.pose is None or (self._linear.speed < _REST and self._angular.speed < _REST)

    @property
    def velocity(self) -> tuple[Array, Array]:
        """The velocity of the pose's position (3,) [m/s] and of its rotation (3,) [rad/s], in the axes of the poses."""
        return self._linear.velocity, self._angular.velocity

    def reset(self, pose: pin.SE3 | None, now: float) -> None:
        """Rest at ``pose`` from ``now`` [s] on; None if there is no pose yet."""
        self.pose: pin.SE3 | None = pose
        self._target: pin.SE3 | None = None
        self._now = now
        self._linear.velocity = self._angular.velocity = np.zeros(3)

    def step(self, target: pin.SE3 | None, now: float) -> pin.SE3 | None:
        """Return the pose at ``now`` [s], one step nearer to the target.

        Args:
            target: The target. If it is None or not finite, the pose brakes and holds.
            now: The time [s]. If it does not advance, the pose stays the same.

        Returns:
            The pose; None before the first :meth:`reset`.
        """
        gap = now - self._now
        if self.pose is None or not gap > 0.0:
            return self.pose
        # The pose starts again from rest, because the arm that follows it has come to rest meanwhile, or will soon do
        # so.
        if gap > LONGEST_DT:
            self._linear.velocity = self._angular.velocity = np.zeros(3)
        dt = gap
        if gap > self._period:
            dt = self._pacer.step(gap, np.array([self._linear.speed, self._angular.speed]))
        self._now = now
        at = self.pose
        if target is None or not all(map(math.isfinite, pin.SE3ToXYZQUATtuple(target))):
            self._target, limited = None, False
            shift, turn = (motion.towards(np.zeros(3), dt)[0] for motion in (self._linear, self._angular))
        else:
            last, self._target = self._target or at, target
            # In a late step, the pose follows only this fraction of the target's motion now. The rest counts as lag.
            share = dt / gap
            start, end = last.translation, target.translation
            shift, slow = self._linear.follow(start - at.translation, end - start, share, dt)
            start, end = last.rotation, target.rotation
            lag, moved = pin.log3(start @ at.rotation.T), pin.log3(end @ start.T)
            turn, slow_turn = self._angular.follow(lag, moved, share, dt)
            limited = slow or slow_turn
        self.clipped += limited
        rotation = pin.Quaternion(pin.exp3(turn) @ at.rotation).normalized()
        self.pose = pin.SE3(rotation, at.translation + shift)
        return self.pose


class _Limited:
    """The velocity of a position or a rotation, within limits of velocity and acceleration."""

    limits: tuple[float, float]  # The limits of velocity [m/s or rad/s] and of acceleration [m/s^2 or rad/s^2].
    velocity: Array  # The present velocity (3,) [m/s] or [rad/s].

    @property
    def speed(self) -> float:
        return math.hypot(*self.velocity)

    def follow(self, lag: Array, moved: Array, share: float, dt: float) -> tuple[Array, bool]:
        """Return the step towards a moving target (3,) [m or rad], and whether a limit has reduced the step.

        Args:
            lag: Vector from the pose to the target (3,) [m or rad].
            moved: Displacement of the target since the last step (3,) [m or rad].
            share: Share of this displacement that the pose follows in this step. The rest counts as lag.
            dt: Duration of the step [s].
        """
        if share < 1.0:
            lag, moved = lag + (1.0 - share) * moved, share * moved
        own, (fastest, a) = moved / dt, self.limits
        if math.hypot(*own) > fastest:
            lag, own = lag + moved, np.zeros(3)
        distance, wanted = math.hypot(*lag), own
        if distance > 0.0:
            speed = min(distance / dt, a * (-0.5 * dt + math.sqrt(0.25 * dt * dt + 2.0 * distance / a)))
            wanted = own + (speed / distance) * lag
        shift, limited = self.towards(wanted, dt)
        return shift, limited or distance > fastest * dt

    def towards(self, wanted: Array, dt: float) -> tuple[Array, bool]:
        """Return the step of ``dt`` [s] at the permitted velocity nearest to ``wanted``, and whether the two differ."""
        fastest, acceleration = self.limits
        change = _at_most(wanted, fastest) - self.velocity
        self.velocity = self.velocity + _at_most(change, acceleration * dt)
        return self.velocity * dt, math.dist(self.velocity, wanted) > _REST


def _at_most(vector: Array, length: float) -> Array:
    norm = math.hypot(*vector)
    return vector if norm <= length else vector * (length / norm)
