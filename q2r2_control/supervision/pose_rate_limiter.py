"""What a target keeps to on its way to a controller that has no limits of its own."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.quaternions import (
    IDENTITY,
    Vector,
    floats_of,
    normalized,
    se3_of,
    turn_between,
    turned_by,
)
from q2r2_control.supervision.tick_pacer import TickPacer
from q2r2_control.types import LONGEST_DT, Pose

_REST = 1e-9  # slower than this is at rest [m/s, rad/s]
_ZERO: Vector = (0.0, 0.0, 0.0)


class PoseRateLimiter:
    """Follows a target within limits of velocity and acceleration, and comes to rest where there is none.

    Within the limits a target that moves steadily is followed without lag: what is limited is the speed relative to
    it, v = u + e/|e| s(|e|), with u the target's own velocity, e the lag and s the largest speed from which full
    braking in steps of dt still stops at it,

        s(d) = min(d / dt, a (-dt/2 + sqrt(dt^2/4 + 2 d/a))).

    A step of the target faster than the limit is no motion of it; then u = 0. Rotations are limited the same way by
    the rotation vector from pose to target. Poses are in one frame, whichever; quaternions stay of unit length over any
    number of steps. Nothing but :meth:`reset` makes the pose jump, and a step that comes late moves it no farther than
    the velocity limits allow in one period, see :mod:`tick_pacer`. After a gap of more than 0.1 s it begins from rest:
    whatever followed it stands at the last pose, and the way that was left to brake on would move it once more.
    """

    def __init__(self, settings: GuardSettings, period: float) -> None:
        """``period`` [s]: of the steps."""
        self.pose: pin.SE3 | None = None
        self.clipped = 0  # steps in which a limit held the pose back, since the start
        self._linear, self._angular = _Limited(), _Limited()
        self._at: Pose = _ZERO, IDENTITY  # of ``pose``, in floats: they take a fraction of the time of NumPy's arrays
        self._target: Pose | None = None
        self._now, self._period = -math.inf, period
        self.change(settings)

    def change(self, settings: GuardSettings) -> None:
        """Other limits from the next step on. A pose that is faster than it may be now brakes at the acceleration."""
        self.settings = settings
        self._linear.limit(settings.max_velocity, settings.max_acceleration)
        self._angular.limit(settings.max_angular_velocity, settings.max_angular_acceleration)
        # A step changes the velocity first and moves by the new one for all of dt: |v| dt + a dt^2, not half of that.
        velocities = np.array([settings.max_velocity, settings.max_angular_velocity])
        accelerations = np.array([settings.max_acceleration, settings.max_angular_acceleration])
        self._pacer = TickPacer(self._period, velocities, 2.0 * accelerations)

    @property
    def at_rest(self) -> bool:
        """Whether the pose stands still, which it also does when there is none."""
        return self.pose is None or (self._linear.speed < _REST and self._angular.speed < _REST)

    def reset(self, pose: pin.SE3 | None, now: float) -> None:
        """Rest at ``pose``, or at none, from ``now`` [s] on."""
        self.pose, self._target, self._now = None, None, now
        if pose is not None:
            position, rotation = floats_of(pose)
            self._at = position, normalized(rotation)
            self.pose = se3_of(self._at)
        self._linear.stop()
        self._angular.stop()

    def step(self, target: pin.SE3 | None, now: float) -> pin.SE3 | None:
        """The pose at ``now`` [s], nearer to ``target``; None or a target that is not finite: brake and hold.

        None before the first :meth:`reset`. A time that does not advance returns the same pose again.
        """
        gap = now - self._now
        if self.pose is None or not gap > 0.0:
            return self.pose
        if gap > LONGEST_DT:  # whatever follows has come to rest meanwhile, or is about to
            self._linear.stop()
            self._angular.stop()
        dt = gap
        if gap > self._period:
            dt = self._pacer.step(gap, np.array([self._linear.speed, self._angular.speed]))
        self._now = now
        at, faces = self._at
        wanted = None if target is None else floats_of(target)
        if wanted is None or not _is_finite(wanted):
            limited = False
            self._target = None
            shift, turn = self._linear.brake(dt), self._angular.brake(dt)
        else:
            last, self._target = self._target or self._at, wanted
            lag, way = _sum(last[0], at, -1.0), _sum(wanted[0], last[0], -1.0)
            angle_lag, angle_way = turn_between(faces, last[1]), turn_between(last[1], wanted[1])
            # Of a late step only the part that is moved now counts as the target's own motion; the rest is lag.
            now_share, late_share = dt / gap, 1.0 - dt / gap
            shift, slow = self._linear.follow(_sum(lag, way, late_share), _scaled(way, now_share), dt)
            turn, slow_turn = self._angular.follow(
                _sum(angle_lag, angle_way, late_share), _scaled(angle_way, now_share), dt
            )
            limited = slow or slow_turn
        self.clipped += limited
        self._at = _sum(at, shift), normalized(turned_by(faces, turn))
        self.pose = se3_of(self._at)
        return self.pose


class _Limited:
    """Velocity of a position or a rotation that is bounded together with its change.

    In every tick, where sums of three floats take a tenth of the time that NumPy takes for arrays of three.
    """

    def __init__(self) -> None:
        self.limit(0.0, 0.0)
        self.stop()

    def limit(self, velocity: float, acceleration: float) -> None:
        self._max, self._acceleration = velocity, acceleration

    @property
    def speed(self) -> float:
        return math.hypot(*self._velocity)

    def stop(self) -> None:
        self._velocity = _ZERO

    def brake(self, dt: float) -> Vector:
        """What to move in ``dt`` [s] while coming to rest."""
        return self._towards(_ZERO, dt)[0]

    def follow(self, lag: Vector, way: Vector, dt: float) -> tuple[Vector, bool]:
        """What to move in ``dt`` [s], and whether that is less than asked for.

        ``lag`` is from the pose to the last target, ``way`` from that to this one.
        """
        own = _scaled(way, 1.0 / dt)
        if math.hypot(*own) > self._max:
            lag, own = _sum(lag, way), _ZERO
        distance = math.hypot(*lag)
        wanted = own
        if distance > 0.0:
            a = self._acceleration
            speed = min(distance / dt, a * (-0.5 * dt + math.sqrt(0.25 * dt * dt + 2.0 * distance / a)))
            wanted = _sum(own, lag, speed / distance)
        shift, limited = self._towards(wanted, dt)
        return shift, limited or distance > self._max * dt

    def _towards(self, wanted: Vector, dt: float) -> tuple[Vector, bool]:
        change = _sum(_at_most(wanted, self._max), self._velocity, -1.0)
        self._velocity = _sum(self._velocity, _at_most(change, self._acceleration * dt))
        return _scaled(self._velocity, dt), math.dist(self._velocity, wanted) > _REST


def _at_most(vector: Vector, length: float) -> Vector:
    norm = math.hypot(*vector)
    return vector if norm <= length else _scaled(vector, length / norm)


def _scaled(a: Vector, factor: float) -> Vector:
    x, y, z = a
    return factor * x, factor * y, factor * z


def _sum(a: Vector, b: Vector, factor: float = 1.0) -> Vector:
    """a + factor b."""
    (x, y, z), (dx, dy, dz) = a, b
    return x + factor * dx, y + factor * dy, z + factor * dz


def _is_finite(pose: Pose) -> bool:
    # A sum with NaN or infinity in it is not finite; nor is the quaternion of a matrix with one.
    return math.isfinite(sum(pose[0]) + sum(pose[1]))
