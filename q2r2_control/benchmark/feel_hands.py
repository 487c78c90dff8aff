"""What a hand does along one axis while it is measured what an operator feels: ways [m] over time [s], from 0 on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from q2r2_control.inputs.way_points import minimum_jerk

Way = Callable[[float], float]

SETTLES = 0.7  # of every tone and tremor, before it is measured [s]


def tone(frequency: float, amplitude: float, speed: float = 0.0) -> Way:
    """A sine [Hz], [m] that grows within the first half of :data:`SETTLES`, on top of a steady motion [m/s]."""

    def way(t: float) -> float:
        return amplitude * _grown(t) * math.sin(2.0 * math.pi * frequency * t) + speed * t

    return way


def tremor(band: tuple[float, float], rms: float, period: float, seed: int, speed: float = 0.0) -> Way:
    """Noise that is flat within ``band`` [Hz], nothing outside, with this ``rms`` [m], on top of a steady motion [m/s].

    It repeats after ``period`` [s], over which its RMS is exact: the sum of all tones of the band that do, equally
    large, with phases drawn from ``seed``.
    """
    low, high = (round(frequency * period) for frequency in band)
    turns = 2.0 * math.pi * np.arange(low, high + 1) / period
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, len(turns))
    amplitude = rms * math.sqrt(2.0 / len(turns))

    def way(t: float) -> float:
        return amplitude * _grown(t) * float(np.sin(turns * t + phases).sum()) + speed * t

    return way


def stop(speed: float, ramp: float, cruises: float) -> Way:
    """Speeds up within ``ramp`` [s], goes on until ``cruises`` [s], and stops within ``ramp``."""

    def way(t: float) -> float:
        up = min(max(t, 0.0), ramp)
        along = min(max(t - ramp, 0.0), cruises - ramp)
        down = min(max(t - cruises, 0.0), ramp)
        return speed * (0.5 * up * up / ramp + along + down - 0.5 * down * down / ramp)

    return way


def reaches(lengths_and_times: Sequence[tuple[float, float]], rest: float) -> Way:
    """Reaches of least jerk (Flash and Hogan 1985) of these lengths [m] and times [s], each to and fro.

    Each is followed by a ``rest`` [s].
    """

    def way(t: float) -> float:
        for length, time in lengths_and_times:
            for to in (True, False):
                if t < time + rest:
                    done = minimum_jerk(min(max(t / time, 0.0), 1.0))
                    return length * (done if to else 1.0 - done)
                t -= time + rest
        return 0.0

    return way


def _grown(t: float) -> float:
    share = min(max(t, 0.0) / (0.5 * SETTLES), 1.0)
    return math.sin(0.5 * math.pi * share) ** 2
