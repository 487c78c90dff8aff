"""From irregular samples of a trembling hand to a smooth pose at every control tick, with one known delay.

:class:`Interpolator` plays the samples back a constant time after their receipt, so that the control loop sees straight
lines instead of 13 ms steps. :class:`OneEuro` then takes the tremor out, and :class:`RestingPose` the noise of a hand
that rests. Everything is in seconds and takes the dt of each tick, so neither the headset's rate nor the loop's changes
what the operator feels. Rotations are filtered by their logarithm, so q and -q are the same.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from q2r2_control.config.teleop import FilterSettings
from q2r2_control.quaternions import IDENTITY, Quaternion, Vector, normalized, turn_between, turned_by
from q2r2_control.types import Pose

_MIN_SPACING = 0.005  # closer samples are merged: over so short a time receipt jitter would look like speed [s]
_USUAL_PERIOD = 1.0 / 75.0  # of a headset's samples, until they are known [s]
_PHASE_SHARE, _PERIOD_SHARE = 0.2, 0.02  # of a sample's jitter that its time, and the period, follow
_CATCH_UP = 0.5  # of a gap in the stream, the part in which what was missed is made up for


class Interpolator:
    """Plays samples back ``delay`` seconds after their receipt, straight from each to the next.

    A headset measures evenly, and its samples come unevenly. A delay-locked loop (Adriaensen 2005) takes the jitter out
    of their times, which would look like speed. It starts anew where a sample comes half a period early or late.
    When no sample comes for longer than ``delay``, it rests at the newest: nothing is extrapolated. It then
    makes up for the motion that it missed within a part of the gap, and not at once.
    """

    def __init__(self, delay: float, period: float = _USUAL_PERIOD) -> None:
        """``period``: of the samples, until it is known [s]."""
        self.delay, self._usual_period = delay, period
        self._knots: deque[tuple[float, Vector, Quaternion]] = deque()
        self._velocity: tuple[Vector, Vector] | None = None  # from the first knot to the second; None: not known yet

    def reset(self, position: Vector, rotation: Quaternion, now: float) -> None:
        self._knots, self._velocity = deque([(now - self.delay, position, rotation)]), None
        self._stamp, self._caught_up = now, -math.inf  # of the last sample, and the end of the way after a gap [s]
        self._even = -math.inf  # when the last sample was measured, but for a constant [s]
        self._period = self._usual_period

    def add(self, position: Vector, rotation: Quaternion, stamp: float, now: float) -> None:
        """Append a sample received at ``stamp`` <= ``now`` [s]; ``reset`` has to come first."""
        knots, self._velocity = self._knots, None
        gap, self._stamp = stamp - self._stamp, stamp
        if gap > 2.0 * self.delay:
            self._caught_up = knots[0][0] + _CATCH_UP * gap
        jitter = stamp - self._even - self._period
        if abs(jitter) < self._period / 2.0:
            self._period += _PERIOD_SHARE * jitter
            stamp += (_PHASE_SHARE - 1.0) * jitter
        self._even = stamp
        while len(knots) > 1 and stamp - knots[-1][0] < _MIN_SPACING:
            knots.pop()
        # A sample in time is reached after the whole delay; so is a late one, without a faster motion.
        earliest = max(self._caught_up, knots[0][0] + max(self.delay / 2.0, _MIN_SPACING))
        knots.append((max(stamp, earliest), position, rotation))

    def at(self, now: float) -> tuple[Vector, Quaternion, Vector]:
        """The position and rotation played back at ``now`` [s], which never goes back, and the turn since the last."""
        playhead, knots = now - self.delay, self._knots
        last, passed = knots[0][2], False
        while len(knots) > 1 and knots[1][0] <= playhead:
            knots.popleft()
            passed, self._velocity = True, None
        (start, (x, y, z), rotation), turn = knots[0], (0.0, 0.0, 0.0)
        if len(knots) > 1:
            if self._velocity is None:
                end, to, turned = knots[1]
                rate, (a, b, c) = 1.0 / (end - start), turn_between(rotation, turned)
                linear = rate * (to[0] - x), rate * (to[1] - y), rate * (to[2] - z)
                self._velocity = linear, (rate * a, rate * b, rate * c)
            (linear, angular), dt = self._velocity, playhead - start
            x, y, z = x + dt * linear[0], y + dt * linear[1], z + dt * linear[2]
            turn = dt * angular[0], dt * angular[1], dt * angular[2]
            rotation = turned_by(rotation, turn)
        # The next line starts here, so a sample that replaces another cannot make the output step.
        knots[0] = playhead, (x, y, z), rotation
        return (x, y, z), rotation, turn_between(last, rotation) if passed else turn


class OneEuro:
    """One-Euro filter (Casiez, Roussel, Vogel, CHI 2012) of a vector or a rotation, with the same delay at every speed.

    The cutoff rises with speed: f = min_cutoff + beta |v|. The original lags by tau = 1 / (2 pi f), thus by an amount
    that changes along the path and bends it. Here the input is led by (tau - delay) v, v being the velocity estimate
    that the filter has anyway. At any constant velocity the output lags by exactly ``delay``. Since tau v <= 1 / (2 pi
    beta), the lead is bounded, and so is what it adds when the hand stops suddenly.
    """

    def __init__(self, min_cutoff: float, beta: float, derivative_cutoff: float, delay: float) -> None:
        self.delay = delay
        self._least_rate, self._rate_per_speed = 2.0 * math.pi * min_cutoff, 2.0 * math.pi * beta  # of 1 / tau
        self._derivative_tau = 1.0 / (2.0 * math.pi * derivative_cutoff)
        self.reset()

    def reset(self) -> None:
        self._velocity = (0.0, 0.0, 0.0)

    def correction(self, error: Sequence[float], step: Sequence[float], dt: float) -> Vector:
        """The output's change over a tick of ``dt`` > 0 [s].

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

    Constant velocity comes out :attr:`FilterSettings.delay` late; a change within about 1 / (2 pi derivative_cutoff).
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


# A hand rests while the mean of its newest samples is this near to that of all since it came to rest. In addition no
# sample is farther from it than a headset's noise makes one in thousands [m], [rad]. With more noise both bounds grow.
_NEWEST, _DRIFTED, _FAR = 8, (0.35e-3, 2e-3), (1.0e-3, 5e-3)
_NOISE, _NOISE_SAMPLES = (0.2e-3, 1.0e-3), (4, 50)  # per axis [m], [rad]; and for how many it counts, at first and most
_LONGEST = 150  # samples of the mean: two seconds of a 75 Hz headset
_TRUSTED = 10, 50  # the mean begins to count from so many samples on, and is all that counts from so many
_LEAVING = 0.05  # the mean of a hand that moves again counts for so long, less and less [s]
_TURNED = 0.3  # farther from its origin another rest begins: only short rotation vectors can be averaged [rad]

_Sample = Sequence[float]  # position [m] and rotation vector from the origin [rad]; a few floats cost less than NumPy


class RestingPose:
    """Draws a filtered pose towards the mean of a hand that rests."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        self._origin = IDENTITY  # rotations are told as vectors from here
        self._newest: deque[_Sample] = deque(maxlen=_NEWEST)
        self._mean: _Sample = (0.0,) * 6
        self._count = 0  # samples that are known of this rest
        self._held: Pose = (0.0, 0.0, 0.0), IDENTITY  # the mean that is drawn to
        self._leaving = False  # that mean is of a rest that is over
        self._share, self._now = 0.0, 0.0
        self._last: deque[_Sample] = deque(maxlen=2)
        self._noise, self._noise_count = [one**2 for one in _NOISE], _NOISE_SAMPLES[0]  # variance of an axis

    def add(self, pose: Pose) -> None:
        position, rotation = pose
        turn = turn_between(self._origin, rotation)
        known = self._count > 0 and math.hypot(*turn) <= _TURNED
        if not known:
            self._origin, turn = rotation, (0.0, 0.0, 0.0)
            self._last.clear()
        sample = (*position, *turn)
        self._measure_noise(sample)
        if not known or self._away(sample, _FAR):
            self._newest.clear()
            self._newest.append(sample)
            self._leave(sample, 1)
            return
        self._newest.append(sample)
        self._count += 1
        share = 1.0 / min(self._count, _LONGEST)
        self._mean = [mean + share * (new - mean) for mean, new in zip(self._mean, sample, strict=True)]
        if self._count > _NEWEST:
            newest = [sum(values) / _NEWEST for values in zip(*self._newest, strict=True)]
            if self._away(newest, _DRIFTED):
                self._leave(newest, _NEWEST)

    def begin(self, newest: Pose, now: float) -> Pose:
        """Where the hand is at ``now`` [s]: at the mean if it rests, else at its ``newest`` pose."""
        self._now, self._leaving, self._share = now, False, self._trusted
        self._held = self._mean_pose() if self._share > 0.0 else newest
        return self._held

    def draw(self, pose: Pose, now: float) -> Pose:
        """The filtered ``pose`` at ``now`` [s], drawn towards the mean as far as that is to be trusted."""
        passed, self._now = max(now - self._now, 0.0) / _LEAVING, now
        if self._leaving:
            self._share = max(self._share - passed, 0.0)
            self._leaving = self._share > 0.0
        else:
            self._share = min(self._trusted, self._share + passed)
        if self._share == 0.0:
            return pose  # as while a hand moves
        if not self._leaving:
            self._held = self._mean_pose()
        share, ((x, y, z), rotation), ((to_x, to_y, to_z), to) = self._share, pose, self._held
        a, b, c = turn_between(rotation, to)
        position = x + share * (to_x - x), y + share * (to_y - y), z + share * (to_z - z)
        return position, turned_by(rotation, (share * a, share * b, share * c))

    @property
    def _trusted(self) -> float:
        least, most = _TRUSTED
        return min(max((self._count - least) / (most - least), 0.0), 1.0)

    def _mean_pose(self) -> Pose:
        x, y, z, a, b, c = self._mean
        return (x, y, z), turned_by(self._origin, (a, b, c))

    def _measure_noise(self, sample: _Sample) -> None:
        """From second differences, which steady motion has none of, and white noise six times its variance."""
        if len(self._last) == 2:
            self._noise_count = min(self._noise_count + 1, _NOISE_SAMPLES[1])
            bends = [new - 2.0 * last + before for before, last, new in zip(*self._last, sample, strict=True)]
            for index, part in enumerate((bends[:3], bends[3:])):
                self._noise[index] += (math.hypot(*part) ** 2 / 18.0 - self._noise[index]) / self._noise_count
        self._last.append(sample)

    def _away(self, sample: _Sample, bounds: tuple[float, float]) -> bool:
        off = [new - mean for mean, new in zip(self._mean, sample, strict=True)]
        return any(
            math.hypot(*part) > bound * max(1.0, math.sqrt(variance) / usual)
            for part, bound, variance, usual in zip((off[:3], off[3:]), bounds, self._noise, _NOISE, strict=True)
        )

    def _leave(self, mean: _Sample, count: int) -> None:
        self._leaving = True
        self._mean, self._count = mean, count
