"""Turn the irregular samples of a trembling hand into a smooth pose at every control tick, with one known delay.

:class:`Interpolator` plays the samples back a constant time after their receipt. The control loop then sees straight
lines between the samples instead of a step every 13 ms. :class:`OneEuro` then removes the tremor, and
:class:`RestingPose` the noise of a hand at rest. No setting counts samples or ticks, so the filter feels the same at
every rate of the headset and of the loop. Rotations are filtered as rotation vectors, because a quaternion and its
negative are the same rotation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from q2r2_control.config.teleop import FilterSettings
from q2r2_control.quaternions import IDENTITY, Quaternion, Vector, normalized, turn_between, turned_by
from q2r2_control.types import Pose

# Samples that arrive within this time are merged, because the jitter of their receipt would look like speed [s].
_MIN_SPACING = 0.005
_USUAL_PERIOD = 1.0 / 75.0  # Period of a headset's samples that is assumed until it is measured [s].
# Gains of the delay-locked loop: the shares of a sample's jitter that correct the sample's time and the period.
_PHASE_SHARE, _PERIOD_SHARE = 0.2, 0.02
_CATCH_UP = 0.5  # After a gap in the stream, the output catches up with the hand in this share of the gap's duration.


class Interpolator:
    """Plays samples back ``delay`` seconds after their receipt, on straight lines from sample to sample.

    A headset measures at constant intervals, but its samples arrive at irregular times. This jitter would look like
    speed. A delay-locked loop (Adriaensen 2005) removes it. The loop starts again when a sample is half a period early
    or late. If no sample comes for longer than ``delay``, the output rests at the newest sample, because nothing is
    extrapolated. When samples come again, the output does not jump: it catches up with the hand in the share
    ``_CATCH_UP`` of the gap's duration.
    """

    def __init__(self, delay: float, period: float = _USUAL_PERIOD) -> None:
        """Make an interpolator.

        Args:
            delay: Delay from the receipt of a sample until it is played back [s].
            period: First estimate of the samples' period [s].
        """
        self.delay, self._usual_period = delay, period
        self._knots: deque[tuple[float, Vector, Quaternion]] = deque()
        # The velocity from the first knot to the second one; None until it is needed.
        self._velocity: tuple[Vector, Vector] | None = None

    def reset(self, position: Vector, rotation: Quaternion, now: float) -> None:
        self._knots, self._velocity = deque([(now - self.delay, position, rotation)]), None
        # The time of the last sample, and the time at which the output has caught up after a gap [s].
        self._stamp, self._caught_up = now, -math.inf
        # Estimate of the time at which the last sample was measured, plus a constant [s].
        self._even = -math.inf
        self._period = self._usual_period

    def add(self, position: Vector, rotation: Quaternion, stamp: float, now: float) -> None:
        """Append a sample that was received at ``stamp`` <= ``now`` [s], after :meth:`reset`."""
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
        # If a sample comes late, the output takes at least half the delay to reach it. With less time, the output would
        # have to move too fast.
        earliest = max(self._caught_up, knots[0][0] + max(self.delay / 2.0, _MIN_SPACING))
        knots.append((max(stamp, earliest), position, rotation))

    def at(self, now: float) -> tuple[Vector, Quaternion, Vector]:
        """Return the position [m] and the rotation at ``now`` [s].

        The third value is the rotation vector from the previous call's rotation to this call's rotation [rad].

        ``now`` must not go back.
        """
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
        # The present line now starts at the output, so that the output does not jump if a new sample replaces the
        # line's end.
        knots[0] = playhead, (x, y, z), rotation
        return (x, y, z), rotation, turn_between(last, rotation) if passed else turn


class OneEuro:
    """One-Euro filter (Casiez, Roussel, Vogel, CHI 2012) of a vector or a rotation, with the same delay at every speed.

    The cutoff rises with speed: f = min_cutoff + beta |v|. The original filter lags by tau = 1 / (2 pi f). This delay
    changes with the speed, and so the output leaves the hand's path. Here the input is moved ahead by (tau - delay) v,
    where v is the filter's own estimate of the velocity. At constant velocity the output then lags by exactly
    ``delay``. Since tau |v| <= 1 / (2 pi beta), this displacement is bounded. If the hand stops suddenly, the
    overshoot is bounded too.
    """

    def __init__(self, min_cutoff: float, beta: float, derivative_cutoff: float, delay: float) -> None:
        self.delay = delay
        # The rate 1 / tau is the first number plus the product of the second number and the speed.
        self._least_rate, self._rate_per_speed = 2.0 * math.pi * min_cutoff, 2.0 * math.pi * beta
        self._derivative_tau = 1.0 / (2.0 * math.pi * derivative_cutoff)
        self.reset()

    def reset(self) -> None:
        self._velocity = (0.0, 0.0, 0.0)

    def correction(self, error: Sequence[float], step: Sequence[float], dt: float) -> Vector:
        """Return the change of the output in a tick.

        The integration is a backward Euler step. It is stable for every dt, and exact at constant velocity and dt.

        Args:
            error: This tick's input minus the last tick's output. For rotations it is a rotation vector.
            step: This tick's input minus the last tick's input, in the same form.
            dt: Duration of the tick, above 0 [s].
        """
        x, y, z = self._velocity
        rate = 1.0 / (self._derivative_tau + dt)
        kept = rate * self._derivative_tau
        self._velocity = x, y, z = kept * x + rate * step[0], kept * y + rate * step[1], kept * z + rate * step[2]
        tau = 1.0 / (self._least_rate + self._rate_per_speed * math.hypot(x, y, z))
        share, lead = dt / (tau + dt), tau - self.delay
        return share * (error[0] + lead * x), share * (error[1] + lead * y), share * (error[2] + lead * z)


class PoseFilter:
    """Interpolates and filters the pose of one hand.

    At constant velocity the output lags by :attr:`FilterSettings.delay`. After a change of velocity it takes about
    1 / (2 pi derivative_cutoff) until the lag has this value again.
    """

    def __init__(self, settings: FilterSettings) -> None:
        smoothing = settings.derivative_cutoff, settings.smoothing_delay
        self._interpolator = Interpolator(settings.interpolation_delay)
        self._position = OneEuro(settings.min_cutoff, settings.beta, *smoothing)
        self._rotation = OneEuro(settings.min_cutoff, settings.rotation_beta, *smoothing)
        self.reset(((0.0, 0.0, 0.0), IDENTITY), 0.0)

    def reset(self, pose: Pose, now: float) -> None:
        """Rest at ``pose`` from ``now`` [s] on, and forget earlier samples."""
        self._out = pose
        self._in, rotation = pose
        self._interpolator.reset(self._in, rotation, now)
        self._position.reset()
        self._rotation.reset()
        self._now = now

    def add(self, pose: Pose, stamp: float, now: float) -> None:
        """Add a sample received at ``stamp`` [s]."""
        # The quaternion is normalised, because rounding errors of quaternion products add up. Once per sample is
        # enough.
        self._out = self._out[0], normalized(self._out[1])
        self._interpolator.add(*pose, stamp, now)

    def at(self, now: float) -> Pose:
        """Return the filtered pose at ``now`` [s]; the last pose if ``now`` is not later than in the previous call."""
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


# A hand is at rest if two conditions hold. First, the mean of its ``_NEWEST`` newest samples is within ``_DRIFTED`` of
# the mean of all samples since it came to rest [m], [rad]. Second, each sample is within ``_FAR`` of the latter mean
# [m], [rad]. The noise of a headset puts one sample in thousands farther away. Both bounds grow with measured noise.
_NEWEST, _DRIFTED, _FAR = 8, (0.35e-3, 2e-3), (1.0e-3, 5e-3)
_NOISE = 0.2e-3, 1.0e-3  # The noise of one axis that is assumed until it is measured [m], [rad].
_NOISE_SAMPLES = 4, 50  # Weight of the assumed noise, and greatest weight of the measured noise, in samples.
_LONGEST = 150  # Greatest number of samples in the mean: two seconds of a headset at 75 Hz.
_TRUSTED = 10, 50  # Number of samples at which the weight of the mean begins to grow from 0, and at which it is 1.
_LEAVING = 0.05  # When the hand moves again, the weight of the mean falls to zero within this time [s].
# If a hand at rest has turned by more than this, a new mean begins [rad]. Only short rotation vectors can be averaged.
_TURNED = 0.3

# Position [m], and rotation vector from the rotation ``_origin`` [rad]. Six floats are faster than a NumPy array.
_Sample = Sequence[float]


class RestingPose:
    """Moves the filtered pose of a hand at rest towards the mean of the hand's samples, so that noise has no effect."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        self._origin = IDENTITY  # The rotation from which rotation vectors are measured.
        self._newest: deque[_Sample] = deque(maxlen=_NEWEST)
        self._mean: _Sample = (0.0,) * 6
        self._count = 0  # Number of samples since the hand came to rest.
        self._held: Pose = (0.0, 0.0, 0.0), IDENTITY  # The mean towards which the filtered pose is moved.
        self._leaving = False  # Whether the hand has left ``_held`` and the weight of this mean is falling to 0.
        self._share, self._now = 0.0, 0.0
        self._last: deque[_Sample] = deque(maxlen=2)
        # The variance of one axis [m^2], [rad^2], and its weight in samples.
        self._noise, self._noise_count = [one**2 for one in _NOISE], _NOISE_SAMPLES[0]

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
        """Return the hand pose for an anchor at ``now`` [s]: the mean if the hand rests, otherwise ``newest``."""
        self._now, self._leaving, self._share = now, False, self._trusted
        self._held = self._mean_pose() if self._share > 0.0 else newest
        return self._held

    def draw(self, pose: Pose, now: float) -> Pose:
        """Return the filtered ``pose`` at ``now`` [s], moved towards the mean by the weight of the mean."""
        passed, self._now = max(now - self._now, 0.0) / _LEAVING, now
        if self._leaving:
            self._share = max(self._share - passed, 0.0)
            self._leaving = self._share > 0.0
        else:
            self._share = min(self._trusted, self._share + passed)
        if self._share == 0.0:
            return pose  # The hand moves.
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
        """Estimate the noise of one axis from the second differences of samples, which are 0 at constant velocity.

        White noise of variance s² has second differences of variance 6 s². Three axes together give 18 s².
        """
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
