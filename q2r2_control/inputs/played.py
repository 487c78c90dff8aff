"""Play the motion of hands whose poses and buttons are functions of time. The samples are the same in every run."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import count

import numpy as np
import pinocchio as pin

from q2r2_control.types import QUEST_CONTROLS, SIDES, Array, HandInputs, HandSample, HapticFeedback

# Least and greatest measured rate of a headset's samples [Hz].
_RATES = (72.0, 76.0)
_LONGEST_DROPOUT = 5  # Greatest number of samples that are lost one after the other.
_RECEIPT_JITTER = 0.0015  # Scale of the exponential distribution of delays [s].
_ROTATION_NOISE = math.radians(0.03)  # Standard deviation of the noise about each axis [rad].


class SampleTiming(ABC):
    """For the samples of one hand: the times of their measurement, their noise, and the times of their receipt.

    For each sample, the caller takes the next of the ``times``, then calls ``measured`` once, and ``lateness`` once.
    """

    @abstractmethod
    def times(self) -> Iterator[float]:
        """Yield the times of all samples, from 0 on without end [s]."""

    def measured(self, pose: pin.SE3, t: float) -> pin.SE3:
        """Return the measurement of a hand that is at ``pose`` at ``t`` [s]."""
        return pose

    def lateness(self) -> float:
        """Return the time from the measurement of a sample to its receipt [s]."""
        return 0.0


class EvenSampling(SampleTiming):
    """Exact poses at a constant rate. Each pose is received after a random delay of up to ``jitter`` [s]."""

    def __init__(self, rate_hz: float, jitter: float = 0.0, seed: int | tuple[int, ...] = 0) -> None:
        self._rate, self._jitter, self._random = rate_hz, jitter, np.random.default_rng(seed)

    def times(self) -> Iterator[float]:
        return (index / self._rate for index in count())

    def lateness(self) -> float:
        return float(self._random.uniform(0.0, self._jitter))


class HeadsetSampling(SampleTiming):
    """Samples like a headset's samples: at an uneven rate of 72-76 Hz, received late, and with sensor noise.

    Args:
        hand: The hand. Each hand has different random numbers.
        seed: Seed of all random numbers.
        position_noise: Standard deviation of the noise along each axis [m].
        tremor: Add the tremor of a human hand, 8-12 Hz with about 1 mm and 0.3 degrees.
        dropout_probability: Probability that a sample is lost. Up to 4 further samples are lost with it.
        shaky: Change the tremor to 6 Hz, 2 mm and 0.6 degrees.
        lost: Start and end of a time span in which all samples are lost [s].
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
        # In each degree of freedom, the tremor is a sum of two sines. Its amplitude rises and falls, like real tremor.
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
        """Return a delay that is shorter than a sample's period, so that the samples keep their order."""
        return min(float(self._random.exponential(_RECEIPT_JITTER)), 0.01)


# Functions of a hand and of the time since the first poll [s]. They return the hand's pose in the input's frame, or its
# buttons.
HandPose = Callable[[str, float], pin.SE3]
HandButtons = Callable[[str, float], HandInputs]

# If the input is not polled for longer than this, the motion waits for the next poll [s].
_LONGEST_BACKLOG = 1.0


class PlayedInput:
    """Gives samples of hands whose poses and buttons are given functions of time. The time starts at the first poll.

    Implements :class:`Input`.
    """

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
        """Do nothing, since played hands have no vibration."""

    def hand_pose(self, hand: str, t: float) -> pin.SE3:
        """Return the pose of ``hand``, without noise, at ``t`` [s] on the clock of the stamps.

        Before any poll, ``t`` is the time since the first poll.
        """
        return self._pose(hand, t - (self._origin or 0.0))

    def poll(self, now: float) -> list[HandSample]:
        """Return the samples that became due since the last poll, oldest first. Each is stamped with its due time."""
        if not self._connected or not math.isfinite(now):
            return []
        if self._origin is None:
            self._origin = now
        backlog = now - self._origin - self._due
        if backlog < 0.0:
            return []  # Most polls come before the next sample is due.
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
        """Return when the next sample becomes due, on the clock of the polls [s]; inf before the first poll."""
        return math.inf if self._origin is None else self._origin + self._due

    def _first_due(self) -> float:
        """Return when the next sample becomes due, in time since the first poll [s]; inf without a hand."""
        return min((sample.pose_stamp for sample in self._next), default=math.inf)

    def _samples(self, hand: str, sampling: SampleTiming) -> Iterator[HandSample]:
        """Yield samples whose stamps are their times of receipt, counted from the first poll [s]."""
        for t in sampling.times():
            pose = sampling.measured(self._pose(hand, t), t)
            due, quaternion = t + sampling.lateness(), pin.Quaternion(pose.rotation).coeffs()
            yield HandSample(hand, pose.translation.copy(), quaternion, due, self._inputs(hand, t), due)
