"""Scripted hands: ideal or human-like motion with button presses, the same at every run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.trajectories import trajectory_named
from q2r2_control.types import SIDES, Array, HandInputs, HandSample, HapticFeedback

# Where an operator holds the hands; only what follows from here on moves an arm.
_HOME = {
    "left": pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.35, 0.25, 1.1])),
    "right": pin.SE3(pin.rpy.rpyToMatrix(-0.1, -0.2, -0.3), np.array([0.35, -0.25, 1.1])),
}
# Rates that a headset was measured to send at [Hz].
_HUMAN_RATES = (72.0, 76.0)
_DROPOUT_PROBABILITY = 0.005
_LONGEST_DROPOUT = 5  # samples
_RECEIPT_JITTER = 0.0015  # [s], scale of an exponential distribution
_POSITION_NOISE, _ROTATION_NOISE = 1e-4, math.radians(0.03)
# Half a central difference of the ideal pose [s].
_DIFFERENCE = 1e-4
# The script pauses when it is not polled for longer than this [s].
_LONGEST_BACKLOG = 1.0


class ScriptedInput:
    """Plays a trajectory of both hands, from the first poll on. Implements :class:`Input`.

    ``human`` adds, all from ``seed``: tremor of 8-12 Hz with about 1 mm and 0.3 degrees, sensor noise, sampling at
    72-76 Hz (``rate_hz`` then means nothing) with late receipts and dropouts of up to 5 samples. The samples do not
    depend on when they are polled. Circle, line and rotate repeat ``frequency_hz`` times a second.

    Raises :class:`ConfigError` for an unknown trajectory or hand, or a rate that is not positive.
    """

    def __init__(
        self,
        trajectory: str,
        hands: Sequence[str] = SIDES,
        human: bool = False,
        seed: int = 0,
        rate_hz: float = 75.0,
        frequency_hz: float = 0.25,
    ) -> None:
        for hand in hands:
            if hand not in SIDES:
                raise ConfigError(f"scripted hand {hand!r}: allowed are {', '.join(SIDES)}")
        for name, value, limit in (("rate_hz", rate_hz, 2000.0), ("frequency_hz", frequency_hz, 2.0)):
            if not 0.0 < value <= limit:
                raise ConfigError(f"scripted input: {name} = {value!r}: allowed is above 0 and up to {limit:g}")
        self._trajectory = trajectory_named(trajectory)
        self._frequency = frequency_hz
        self._streams = [self._samples(hand, _Human(hand, seed) if human else None, rate_hz) for hand in hands]
        self._next = [next(stream) for stream in self._streams]
        self._origin: float | None = None
        self._connected = False

    @property
    def connected(self) -> bool:
        """Between ``start`` and ``close``."""
        return self._connected

    def start(self) -> None:
        """Let polls return samples."""
        self._connected = True

    def close(self) -> None:
        """Let polls return nothing any more."""
        self._connected = False

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Does nothing: a script has no vibration."""

    def hand_pose(self, hand: str, t: float) -> pin.SE3:
        """Where ``hand`` ideally is at ``t`` [s], on the clock of the samples' stamps; script time before any poll."""
        return self._pose(hand, t - (self._origin or 0.0))

    def hand_twist(self, hand: str, t: float) -> pin.Motion:
        """How ``hand`` ideally moves at ``t`` [s], in the axes that its poses have [m/s, rad/s]."""
        t -= self._origin or 0.0  # before the difference, which on a clock that counts since 1970 would be coarse
        before, after = self._pose(hand, t - _DIFFERENCE), self._pose(hand, t + _DIFFERENCE)
        linear = (after.translation - before.translation) / (2.0 * _DIFFERENCE)
        return pin.Motion(linear, pin.log3(after.rotation @ before.rotation.T) / (2.0 * _DIFFERENCE))

    def poll(self, now: float) -> list[HandSample]:
        """Samples that came due since the last poll, with the time they were due as receipt time; oldest first."""
        if not self._connected or not math.isfinite(now):
            return []
        if self._origin is None:
            self._origin = now
        backlog = now - self._origin - min((sample.due for sample in self._next), default=math.inf)
        self._origin += max(backlog - _LONGEST_BACKLOG, 0.0)
        samples = []
        for index, stream in enumerate(self._streams):
            while self._next[index].due <= now - self._origin:
                samples.append(self._next[index].received(self._origin))
                self._next[index] = next(stream)
        return sorted(samples, key=lambda sample: sample.pose_stamp)

    def _pose(self, hand: str, t: float) -> pin.SE3:
        displacement, turn = self._trajectory.displacement(hand, t, self._frequency)
        home = _HOME[hand]
        return pin.SE3(pin.exp3(turn) @ home.rotation, home.translation + displacement)

    def _samples(self, hand: str, human: _Human | None, rate_hz: float) -> Iterator[_Scripted]:
        count, t = 0, 0.0
        while True:
            pose, due = self._pose(hand, t), t
            if human is not None:
                pose, due = human.shaken(pose, t), t + human.lateness()
            yield _Scripted(due, hand, pose, self._trajectory.inputs(hand, t))
            count += 1
            t = t + human.interval() if human is not None else count / rate_hz


@dataclass(frozen=True, slots=True)
class _Scripted:
    due: float  # receipt in script time [s]
    hand: str
    pose: pin.SE3
    inputs: HandInputs

    def received(self, origin: float) -> HandSample:
        stamp = origin + self.due
        quaternion = pin.Quaternion(self.pose.rotation).coeffs()
        return HandSample(self.hand, self.pose.translation.copy(), quaternion, stamp, self.inputs, stamp)


class _Human:
    """What a real hand and headset add: tremor, noise, irregular and missing samples."""

    def __init__(self, hand: str, seed: int) -> None:
        self._random = np.random.default_rng([seed, SIDES.index(hand)])
        # Two tones per degree of freedom beat like a real tremor does.
        self._frequencies = self._random.uniform(8.0, 12.0, (6, 2))
        self._phases = self._random.uniform(0.0, 2.0 * math.pi, (6, 2))
        self._amplitudes = 0.5 * np.array([1e-3] * 3 + [math.radians(0.3)] * 3)

    def shaken(self, pose: pin.SE3, t: float) -> pin.SE3:
        tones = np.sin(2.0 * math.pi * self._frequencies * t + self._phases).sum(axis=1)
        tremor: Array = self._amplitudes * tones
        shift = tremor[:3] + self._random.normal(0.0, _POSITION_NOISE, 3)
        turn = tremor[3:] + self._random.normal(0.0, _ROTATION_NOISE, 3)
        return pin.SE3(pin.exp3(turn) @ pose.rotation, pose.translation + shift)

    def lateness(self) -> float:
        """Receipt after measurement, short of a sample's period so that the order is kept [s]."""
        return min(float(self._random.exponential(_RECEIPT_JITTER)), 0.01)

    def interval(self) -> float:
        """Time to the next sample that is not lost [s]."""
        drops_out = self._random.random() < _DROPOUT_PROBABILITY
        lost = int(self._random.integers(1, _LONGEST_DROPOUT + 1)) if drops_out else 0
        return float(sum(1.0 / self._random.uniform(*_HUMAN_RATES, 1 + lost)))
