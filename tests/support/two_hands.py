"""Two human hands as a headset measures them. They share one motion, and each hand deviates from it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin

from q2r2_control.inputs.messages import HandPose
from q2r2_control.inputs.played import HeadsetSampling
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.types import SIDES, Array

START = {"left": np.array([0.35, 0.2, 1.1]), "right": np.array([0.35, -0.2, 1.1])}
PERIOD = 1.0 / 72.0  # Period of samples [s].

# The common motion: a function of the time [s] that returns the pose of the object, relative to its pose at 0 s.
Motion = Callable[[float], pin.SE3]


class TwoHands:
    """Both hands hold one moving object. Each hand sways on its own, trembles, and is measured with noise.

    ``sway`` is the RMS of each hand's own motion at 0.4 .. 2 Hz, along each axis [m] and about each axis [rad]. A
    cardboard box yields under the grips, so the hands that hold it sway by some millimetres and degrees.
    """

    def __init__(
        self,
        motion: Motion,
        seed: int,
        sway: tuple[float, float] = (0.003, math.radians(1.0)),
        tremor: bool = True,
        noise: float = 1e-4,
    ) -> None:
        random = np.random.default_rng(seed)
        self._motion, self._sway = motion, sway
        self._sampling = {hand: HeadsetSampling(hand, seed, tremor=tremor, position_noise=noise) for hand in SIDES}
        self._frequencies = {hand: random.uniform(0.4, 2.0, (6, 3)) for hand in SIDES}
        self._phases = {hand: random.uniform(0.0, 2.0 * math.pi, (6, 3)) for hand in SIDES}

    def pose(self, hand: str, t: float) -> pin.SE3:
        """Return the measured pose of a hand at ``t`` [s]."""
        tones = np.sin(2.0 * math.pi * self._frequencies[hand] * t + self._phases[hand]).sum(axis=1) / math.sqrt(1.5)
        held = self._motion(t)
        position = held.act(START[hand]) + self._sway[0] * tones[:3]
        rotation = pin.exp3(self._sway[1] * tones[3:]) @ held.rotation
        return self._sampling[hand].measured(pin.SE3(rotation, position), t)

    def samples(self, duration: float) -> Iterator[tuple[float, str, HandPose]]:
        """Yield the receipt time [s], hand and pose of each sample, left before right."""
        for index in range(int(duration / PERIOD)):
            for place, hand in enumerate(SIDES):
                yield index * PERIOD + 2e-4 * place, hand, hand_pose(self.pose(hand, index * PERIOD))


def hand_pose(pose: pin.SE3) -> HandPose:
    """Return the pose as the app sends it."""
    return HandPose(pose.translation.copy(), pin.Quaternion(pose.rotation).coeffs(), 12.0, "")


def carry(t: float) -> pin.SE3:
    """Return a motion to and fro by 0.35 m and 20 degrees, with 1.2 s in each direction and rests of 0.4 s."""
    stroke, phase = divmod(t, 1.6)
    share = minimum_jerk(phase / 1.2)
    share = share if stroke % 2 == 0 else 1.0 - share
    way: Array = share * np.array([0.15, 0.3, 0.1])
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, share * math.radians(20.0)])), way)


def rest(t: float) -> pin.SE3:
    """Return a common motion that rests, so that only the hands' own deviations remain."""
    return pin.SE3.Identity()
