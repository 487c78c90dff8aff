"""Plays hands whose poses and buttons are functions of time, the same at every run."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import count

import numpy as np
import pinocchio as pin

from q2r2_control.types import QUEST_CONTROLS, SIDES, Array, HandInputs, HandSample, HapticFeedback

# Rates that a headset was measured to send at [Hz].
_RATES = (72.0, 76.0)
_LONGEST_DROPOUT = 5  # samples
_RECEIPT_JITTER = 0.0015  # [s], scale of an exponential distribution
_ROTATION_NOISE = math.radians(0.03)


class SampleTiming(ABC):
    """How the samples of one hand come about; at each of ``times``, ``measured`` is asked first, then ``lateness``."""

    @abstractmethod
    def times(self) -> Iterator[float]:
        """Times [s] of all samples, from 0 on without end."""

    def measured(self, pose: pin.SE3, t: float) -> pin.SE3:
        """The measurement of a hand that is at ``pose`` at ``t`` [s]."""
        return pose

    def lateness(self) -> float:
        """Receipt of a sample after its measurement [s]."""
        return 0.0


class EvenSampling(SampleTiming):
    """Exact poses at an even rate [Hz], received at once, or each later by up to ``jitter`` [s], from ``seed``."""

    def __init__(self, rate_hz: float, jitter: float = 0.0, seed: int | tuple[int, ...] = 0) -> None:
        self._rate, self._jitter, self._random = rate_hz, jitter, np.random.default_rng(seed)

    def times(self) -> Iterator[float]:
        return (index / self._rate for index in count())

    def lateness(self) -> float:
        return float(self._random.uniform(0.0, self._jitter))


class HeadsetSampling(SampleTiming):
    """A headset's samples, all from ``seed``: uneven at 72-76 Hz, received late, with sensor noise.

    ``position_noise`` is the noise's standard deviation along each axis [m]. ``tremor`` adds that of a human hand, 8-12
    Hz with about 1 mm and 0.3 degrees; a ``shaky`` one's has 6 Hz, 2 mm and 0.6 degrees. ``dropout_probability`` is
    that of every sample to be lost, with up to 4 more. All are lost from the first of ``lost`` to the second [s].
    """

    def __init__(
        self,
        hand: str,
        seed: int,
        *,
        position_noise: float = 1e-4,
        tremor: bool = False,
        dropout_probability: float = 0.0,
        shaky: bool = False,
        lost: tuple[float, float] = (math.inf, math.inf),
    ) -> None:
        self._lost = lost
        self._random = np.random.default_rng([seed, SIDES.index(hand)])
        self._position_noise, self._dropout_probability = position_noise, dropout_probability
        # Two tones per degree of freedom beat like a real tremor does.
        self._frequencies = self._random.uniform(*((5.5, 6.5) if shaky else (8.0, 12.0)), (6, 2))
        self._phases = self._random.uniform(0.0, 2.0 * math.pi, (6, 2))
        self._amplitudes = (1.0 if shaky else 0.5) * tremor * np.array([1e-3] * 3 + [math.radians(0.3)] * 3)

    def times(self) -> Iterator[float]:
        t = 0.0
        while True:
            if not self._lost[0] <= t < self._lost[1]:
                yield t
            drops_out = self._random.random() < self._dropout_probability
            lost = int(self._random.integers(1, _LONGEST_DROPOUT + 1)) if drops_out else 0
            t += float(sum(1.0 / self._random.uniform(*_RATES, 1 + lost)))

    def measured(self, pose: pin.SE3, t: float) -> pin.SE3:
        tones = np.sin(2.0 * math.pi * self._frequencies * t + self._phases).sum(axis=1)
        tremor: Array = self._amplitudes * tones
        shift = tremor[:3] + self._random.normal(0.0, self._position_noise, 3)
        turn = tremor[3:] + self._random.normal(0.0, _ROTATION_NOISE, 3)
        return pin.SE3(pin.exp3(turn) @ pose.rotation, pose.translation + shift)

    def lateness(self) -> float:
        """Short of a sample's period, so that the order is kept."""
        return min(float(self._random.exponential(_RECEIPT_JITTER)), 0.01)


HandPose = Callable[[str, float], pin.SE3]  # hand, time since the first poll [s] -> pose in the input's frame
HandButtons = Callable[[str, float], HandInputs]  # hand, time since the first poll [s]

# The play pauses when it is not polled for longer than this [s].
_LONGEST_BACKLOG = 1.0


class PlayedInput:
    """Samples of hands along given ways, from the first poll on, whenever it is polled. Implements :class:`Input`."""

    controls = replace(QUEST_CONTROLS, words=replace(QUEST_CONTROLS.words, nobody="a script moves the hands"))

    def __init__(self, pose: HandPose, inputs: HandButtons, samplings: Mapping[str, SampleTiming]) -> None:
        self._pose, self._inputs = pose, inputs
        self._streams = [self._samples(hand, sampling) for hand, sampling in samplings.items()]
        self._next = [next(stream) for stream in self._streams]
        self._due = self._first_due()
        self._origin: float | None = None
        self._connected = False

    @property
    def connected(self) -> bool:
        return self._connected

    def start(self) -> None:
        self._connected = True

    def close(self) -> None:
        self._connected = False

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Does nothing: what is played has no vibration."""

    def hand_pose(self, hand: str, t: float) -> pin.SE3:
        """Where ``hand`` ideally is at ``t`` [s], on the clock of the samples' stamps; play time before any poll."""
        return self._pose(hand, t - (self._origin or 0.0))

    def poll(self, now: float) -> list[HandSample]:
        """Samples that came due since the last poll, with the time they were due as receipt time; oldest first."""
        if not self._connected or not math.isfinite(now):
            return []
        if self._origin is None:
            self._origin = now
        backlog = now - self._origin - self._due
        if backlog < 0.0:
            return []  # as at most polls
        self._origin += max(backlog - _LONGEST_BACKLOG, 0.0)
        samples = []
        for index, stream in enumerate(self._streams):
            while (due := self._next[index].pose_stamp) <= now - self._origin:
                stamp = self._origin + due
                samples.append(replace(self._next[index], pose_stamp=stamp, inputs_stamp=stamp))
                self._next[index] = next(stream)
        self._due = self._first_due()
        return sorted(samples, key=lambda sample: sample.pose_stamp)

    def due(self) -> float:
        """When the next sample comes due, on the clock of the polls [s]; inf where there was no poll yet."""
        return math.inf if self._origin is None else self._origin + self._due

    def _first_due(self) -> float:
        """When the next sample comes due in play time [s]; inf where there is no hand."""
        return min((sample.pose_stamp for sample in self._next), default=math.inf)

    def _samples(self, hand: str, sampling: SampleTiming) -> Iterator[HandSample]:
        """With their receipt in play time as stamps."""
        for t in sampling.times():
            pose = sampling.measured(self._pose(hand, t), t)
            due, quaternion = t + sampling.lateness(), pin.Quaternion(pose.rotation).coeffs()
            yield HandSample(hand, pose.translation.copy(), quaternion, due, self._inputs(hand, t), due)
