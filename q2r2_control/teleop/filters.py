"""From irregular samples of a trembling hand to a smooth pose at every control tick, with one known delay.

Two stages. :class:`Interpolator` plays the samples back a constant time after their receipt, so that the control loop
sees straight lines instead of 13 ms steps. :class:`OneEuro` then takes the tremor out. Everything is in seconds and
takes the dt of each tick, so neither the headset's rate nor the loop's changes what the operator feels.

Rotations are filtered as rotations, by their logarithm, so q and -q are the same and nothing is averaged over signs.

All of this runs at every control tick, for vectors of three: sums of three floats cost a tenth of NumPy's calls. So
positions are three floats in here and rotations four, see :mod:`q2r2_control.quaternions`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from q2r2_control.config.teleop import FilterSettings
from q2r2_control.quaternions import IDENTITY, Quaternion, Vector, normalized, turn_between, turned_by
from q2r2_control.types import Pose

# Closer samples are merged: over so short a time receipt jitter would look like speed [s].
_MIN_SPACING = 0.005
_NO_TURN = (0.0, 0.0, 0.0)


class Interpolator:
    """Plays samples back ``delay`` seconds after their receipt, straight from each to the next.

    When no sample comes for longer than ``delay``, it rests at the newest, and continues from there later: the output
    is continuous for any samples, and nothing is extrapolated.
    """

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self._knots: deque[tuple[float, Vector, Quaternion]] = deque()
        self._velocity: tuple[Vector, Vector] | None = None  # from the first knot to the second; None: not known yet

    def reset(self, position: Vector, rotation: Quaternion, now: float) -> None:
        """Rest at a pose."""
        self._knots, self._velocity = deque([(now - self.delay, position, rotation)]), None

    def add(self, position: Vector, rotation: Quaternion, stamp: float, now: float) -> None:
        """Append a sample received at ``stamp`` <= ``now`` [s]; ``reset`` has to come first."""
        knots, self._velocity = self._knots, None
        while len(knots) > 1 and stamp - knots[-1][0] < _MIN_SPACING:
            knots.pop()
        # A sample in time is reached after the whole delay; so is a late one, without a faster motion.
        earliest = knots[0][0] + max(self.delay / 2.0, _MIN_SPACING)
        knots.append((max(stamp, earliest), position, rotation))

    def at(self, now: float) -> tuple[Vector, Quaternion, Vector]:
        """The position and rotation played back at ``now`` [s], which never goes back, and the turn since the last."""
        playhead, knots = now - self.delay, self._knots
        last = knots[0][2]
        passed = False
        while len(knots) > 1 and knots[1][0] <= playhead:
            knots.popleft()
            passed, self._velocity = True, None
        start, (x, y, z), rotation = knots[0]
        turn = _NO_TURN
        if len(knots) > 1:
            linear, angular = self._velocity = self._velocity or _velocity(*knots[0], *knots[1])
            dt = playhead - start
            x, y, z = x + dt * linear[0], y + dt * linear[1], z + dt * linear[2]
            turn = dt * angular[0], dt * angular[1], dt * angular[2]
            rotation = turned_by(rotation, turn)
        # What was played is where the next line starts, so a sample that replaces another cannot make the output step.
        knots[0] = playhead, (x, y, z), rotation
        return (x, y, z), rotation, turn_between(last, rotation) if passed else turn


def _velocity(
    start: float, position: Vector, rotation: Quaternion, end: float, to: Vector, turned: Quaternion
) -> tuple[Vector, Vector]:
    """Of a straight line from one knot to the next, about one fixed axis."""
    rate = 1.0 / (end - start)
    a, b, c = turn_between(rotation, turned)
    linear = rate * (to[0] - position[0]), rate * (to[1] - position[1]), rate * (to[2] - position[2])
    return linear, (rate * a, rate * b, rate * c)


class OneEuro:
    """One-Euro filter (Casiez, Roussel, Vogel, CHI 2012) of a vector or a rotation, with the same delay at every speed.

    The cutoff rises with speed: f = min_cutoff + beta |v|. The original lags by tau = 1 / (2 pi f), thus by an amount
    that changes along the path and bends it. Here the input is led by (tau - delay) v, v being the velocity estimate
    that the filter has anyway, so at any constant velocity the output lags by exactly ``delay``. Since
    tau v <= 1 / (2 pi beta), the lead is bounded, and so is what it adds when the hand stops suddenly.
    """

    def __init__(self, min_cutoff: float, beta: float, derivative_cutoff: float, delay: float) -> None:
        self.delay = delay
        self._least_rate, self._rate_per_speed = 2.0 * math.pi * min_cutoff, 2.0 * math.pi * beta  # of 1 / tau
        self._derivative_tau = 1.0 / (2.0 * math.pi * derivative_cutoff)
        self.reset()

    def reset(self) -> None:
        """Start from rest."""
        self._velocity = (0.0, 0.0, 0.0)

    def correction(self, error: Sequence[float], step: Sequence[float], dt: float) -> Vector:
        """What to add to the output over a tick of ``dt`` > 0 [s].

        ``error`` is input minus output before the tick, ``step`` input minus previous input; rotation vectors for
        rotations. Backward Euler: stable for every dt, and the lag at constant velocity is exact for any constant dt.
        """
        x, y, z = self._velocity
        rate = 1.0 / (self._derivative_tau + dt)
        kept = rate * self._derivative_tau
        self._velocity = x, y, z = kept * x + rate * step[0], kept * y + rate * step[1], kept * z + rate * step[2]
        tau = 1.0 / (self._least_rate + self._rate_per_speed * math.hypot(x, y, z))
        share, lead = dt / (tau + dt), tau - self.delay
        return share * (error[0] + lead * x), share * (error[1] + lead * y), share * (error[2] + lead * z)


class PoseFilter:
    """Interpolation and One-Euro filter of one hand's pose.

    A hand that moves at constant velocity comes out :attr:`FilterSettings.delay` late, whatever its speed. Velocity
    changes are followed within about 1 / (2 pi derivative_cutoff).
    """

    def __init__(self, settings: FilterSettings) -> None:
        smoothing = settings.derivative_cutoff, settings.smoothing_delay
        self._interpolator = Interpolator(settings.interpolation_delay)
        self._position = OneEuro(settings.min_cutoff, settings.beta, *smoothing)
        self._rotation = OneEuro(settings.min_cutoff, settings.rotation_beta, *smoothing)
        self.reset(((0.0, 0.0, 0.0), IDENTITY), 0.0)

    def reset(self, pose: Pose, now: float) -> None:
        """Rest at ``pose``; earlier samples are forgotten."""
        self._out = pose
        self._in, rotation = pose
        self._interpolator.reset(self._in, rotation, now)
        self._position.reset()
        self._rotation.reset()
        self._now = now

    def add(self, pose: Pose, stamp: float, now: float) -> None:
        """Add a sample received at ``stamp`` [s]."""
        # Products of quaternions add rounding up; a few from one sample to the next do not matter.
        self._out = self._out[0], normalized(self._out[1])
        self._interpolator.add(*pose, stamp, now)

    def at(self, now: float) -> Pose:
        """The filtered pose at ``now`` [s]; a time that does not advance returns the same pose again."""
        dt = now - self._now
        if dt <= 0.0:
            return self._out
        before_x, before_y, before_z = self._in
        (last_x, last_y, last_z), last = self._out
        self._in, rotation, turned = self._interpolator.at(now)
        self._now, (x, y, z) = now, self._in
        shift = self._position.correction(
            (x - last_x, y - last_y, z - last_z), (x - before_x, y - before_y, z - before_z), dt
        )
        turn = self._rotation.correction(turn_between(last, rotation), turned, dt)
        position = last_x + shift[0], last_y + shift[1], last_z + shift[2]
        self._out = position, turned_by(last, turn)
        return self._out
