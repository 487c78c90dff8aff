"""Where a target is at the time of a tick: on the line through the last two that came.

A loop that takes the newest target at each tick sees a target that stands still in one tick and goes twice as far in
the next: sender and loop do not tick together. Then an even motion of a hand leaves as uneven speeds of the joints. So
a target that has moved evenly goes on until the tick, for at most two and a half times the time between the last two.
"""

from __future__ import annotations

import math

import pinocchio as pin

from q2r2_control.quaternions import (
    Vector,
    floats_of,
    inverse,
    product,
    rotation_of,
    rotation_vector,
    se3_of,
)
from q2r2_control.types import Pose

# Between two targets of a line: slower ones are steps, and stamps that are nearer say nothing [s].
_SHORTEST, _LONGEST = 0.001, 0.025
_LOOKAHEAD = 2.5  # of the time between two: one may be left out, and the next one late
# Where the last target was not where the line led to, within this, it does not move evenly and is taken as it is.
_EVEN, _EVEN_TURN = 1.5e-3, 0.01  # [m], [rad]


class TargetExtrapolator:
    """The targets of one stream. Times are those at which targets are due [s]."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all targets; the next one begins a line."""
        self._pose: pin.SE3 | None = None
        self._due = -math.inf
        self._gap = 0.0
        self._at: Pose | None = None  # of the pose, where it is due at a known time; floats, since NumPy takes longer
        self._twist: tuple[Vector, Vector] | None = None  # linear, and angular in the target's frame [m/s], [rad/s]
        self._even = False

    def put(self, pose: pin.SE3, due: float | None) -> None:
        """A target; ``due``: when it is to be reached, None where that is not known."""
        if due is None:
            self.reset()
            self._pose = pose
            return
        last, gap, twist = self._at, due - self._due, self._twist
        self._pose, self._due, self._at = pose, due, floats_of(pose)
        if 0.0 <= gap < _SHORTEST:
            return  # a late tick of its sender, and the next one
        self._twist, self._even = None, False
        if last is None or not _SHORTEST <= gap <= _LONGEST:
            return
        (x, y, z), rotation = self._at
        before, turned = last
        linear = (x - before[0]) / gap, (y - before[1]) / gap, (z - before[2]) / gap
        a, b, c = rotation_vector(product(inverse(turned), rotation))
        angular = a / gap, b / gap, c / gap
        if twist is not None:
            surprise, turn = gap * math.dist(linear, twist[0]), gap * math.dist(angular, twist[1])
            self._even = surprise <= _EVEN and turn <= _EVEN_TURN
        self._gap, self._twist = gap, (linear, angular)

    def at(self, t: float) -> pin.SE3 | None:
        """Where the target is at ``t`` [s]; None where there is none."""
        if self._at is None or self._twist is None or not self._even:
            return self._pose
        (x, y, z), rotation = self._at
        (dx, dy, dz), (a, b, c) = self._twist
        ahead = min(max(t - self._due, -self._gap), _LOOKAHEAD * self._gap)
        turned = product(rotation, rotation_of((ahead * a, ahead * b, ahead * c)))
        return se3_of(((x + ahead * dx, y + ahead * dy, z + ahead * dz), turned))
