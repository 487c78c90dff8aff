"""Where a hand rests, known better than any one sample of it says.

A third of a headset's noise, about 0.2 mm a sample, passes the filter, since a filter that follows a hand within 25 ms
cannot average for long. A hand that rests needs no such haste: here the samples since it came to rest are averaged,
over two seconds at most. Without that each engagement and each pause leaves the tool where the noise was at that
moment, and a hundred of them are a random walk of millimetres.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from q2r2_control.quaternions import IDENTITY, turn_between, turned_by
from q2r2_control.types import Pose

# A hand rests while the mean of its newest samples is this near to that of all since it came to rest, and no sample is
# farther from it than a headset's noise makes one in thousands [m], [rad].
_NEWEST, _DRIFTED, _FAR = 8, (0.35e-3, 2e-3), (1.0e-3, 5e-3)
_LONGEST = 150  # samples of the mean: two seconds of a 75 Hz headset
_TRUSTED = 10, 50  # the mean begins to count from so many samples on, and is all that counts from so many
_LEAVING = 0.05  # the mean of a hand that moves again counts for so long, less and less [s]
# Rotation vectors can be averaged while they are short: farther from the origin of a rest another one begins [rad].
_TURNED = 0.3

_Sample = Sequence[float]  # position [m] and rotation vector from the origin [rad]; a few floats cost less than NumPy


class RestingPose:
    """Draws a filtered pose towards the mean of a hand that rests."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Nothing is known."""
        self._origin = IDENTITY  # rotations are told as vectors from here
        self._newest: deque[_Sample] = deque(maxlen=_NEWEST)
        self._mean: _Sample = (0.0,) * 6
        self._count = 0  # samples that are known of this rest
        self._held: Pose = (0.0, 0.0, 0.0), IDENTITY  # the mean that is drawn to
        self._leaving = False  # that mean is of a rest that is over
        self._share, self._now = 0.0, 0.0

    def add(self, pose: Pose) -> None:
        """A sample of the hand."""
        position, rotation = pose
        turn = turn_between(self._origin, rotation)
        known = self._count > 0 and math.hypot(*turn) <= _TURNED
        if not known:
            self._origin, turn = rotation, (0.0, 0.0, 0.0)
        sample = (*position, *turn)
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
        """The share that the mean may count for."""
        least, most = _TRUSTED
        return min(max((self._count - least) / (most - least), 0.0), 1.0)

    def _mean_pose(self) -> Pose:
        x, y, z, a, b, c = self._mean
        return (x, y, z), turned_by(self._origin, (a, b, c))

    def _away(self, sample: _Sample, bounds: tuple[float, float]) -> bool:
        (x, y, z, a, b, c), (to_x, to_y, to_z, to_a, to_b, to_c) = self._mean, sample
        return (
            math.hypot(to_x - x, to_y - y, to_z - z) > bounds[0] or math.hypot(to_a - a, to_b - b, to_c - c) > bounds[1]
        )

    def _leave(self, mean: _Sample, count: int) -> None:
        """A rest begins whose first ``count`` samples have this ``mean``."""
        self._leaving = True
        self._mean, self._count = mean, count
