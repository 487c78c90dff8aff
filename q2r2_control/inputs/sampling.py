"""When a hand's pose is sampled, and what the measurement adds to it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from itertools import count

import numpy as np
import pinocchio as pin

from q2r2_control.types import SIDES, Array

# Rates that a headset was measured to send at [Hz].
_RATES = (72.0, 76.0)
_LONGEST_DROPOUT = 5  # samples
_RECEIPT_JITTER = 0.0015  # [s], scale of an exponential distribution
_ROTATION_NOISE = math.radians(0.03)


class SampleTiming(ABC):
    """How the samples of one hand come about: exact and at once, unless a subclass says otherwise.

    For each of ``times`` ``measured`` is asked first, then ``lateness``.
    """

    @abstractmethod
    def times(self) -> Iterator[float]:
        """Times [s] of all samples, from 0 on without end."""

    def measured(self, pose: pin.SE3, t: float) -> pin.SE3:
        """What is measured of a hand that is at ``pose`` at ``t`` [s]."""
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
    Hz with about 1 mm and 0.3 degrees; ``dropout_probability`` is that of every sample to be lost, with up to 4 more.
    """

    def __init__(
        self,
        hand: str,
        seed: int,
        *,
        position_noise: float = 1e-4,
        tremor: bool = False,
        dropout_probability: float = 0.0,
    ) -> None:
        self._random = np.random.default_rng([seed, SIDES.index(hand)])
        self._position_noise, self._dropout_probability = position_noise, dropout_probability
        # Two tones per degree of freedom beat like a real tremor does.
        self._frequencies = self._random.uniform(8.0, 12.0, (6, 2))
        self._phases = self._random.uniform(0.0, 2.0 * math.pi, (6, 2))
        self._amplitudes = 0.5 * tremor * np.array([1e-3] * 3 + [math.radians(0.3)] * 3)

    def times(self) -> Iterator[float]:
        t = 0.0
        while True:
            yield t
            t += self._interval()

    def measured(self, pose: pin.SE3, t: float) -> pin.SE3:
        tones = np.sin(2.0 * math.pi * self._frequencies * t + self._phases).sum(axis=1)
        tremor: Array = self._amplitudes * tones
        shift = tremor[:3] + self._random.normal(0.0, self._position_noise, 3)
        turn = tremor[3:] + self._random.normal(0.0, _ROTATION_NOISE, 3)
        return pin.SE3(pin.exp3(turn) @ pose.rotation, pose.translation + shift)

    def lateness(self) -> float:
        """Short of a sample's period, so that the order is kept."""
        return min(float(self._random.exponential(_RECEIPT_JITTER)), 0.01)

    def _interval(self) -> float:
        """Time to the next sample that is not lost [s]."""
        drops_out = self._random.random() < self._dropout_probability
        lost = int(self._random.integers(1, _LONGEST_DROPOUT + 1)) if drops_out else 0
        return float(sum(1.0 / self._random.uniform(*_RATES, 1 + lost)))
