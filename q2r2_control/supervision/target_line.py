"""Where a target is at the time of a tick: on the line through the last two that came.

A loop that takes the newest target at each tick sees a target that stands still in one tick and goes twice as far in
the next: sender and loop do not tick together. Then an even motion of a hand leaves as uneven speeds of the joints. So
a target that has moved evenly goes on until the tick, for at most two and a half times the time between the last two.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.types import pose_of

# Between two targets of a line: slower ones are steps, and stamps that are nearer say nothing [s].
_SHORTEST, _LONGEST = 0.001, 0.025
_LOOKAHEAD = 2.5  # of the time between two: one may be left out, and the next one late
# Where the last target was not where the line led to, within this, it does not move evenly and is taken as it is.
_EVEN, _EVEN_TURN = 1.5e-3, 0.01  # [m], [rad]


class TargetLine:
    """The targets of one stream. Times are those at which targets are due [s]."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all targets; the next one begins a line."""
        self._pose: pin.SE3 | None = None
        self._due = -math.inf
        self._gap = 0.0
        self._position: list[float] = []  # of the pose [m]
        # Linear, and angular in the target's frame [m/s], [rad/s]; floats, since NumPy takes longer for three.
        self._twist: tuple[list[float], list[float]] | None = None
        self._even = False

    def put(self, pose: pin.SE3, due: float | None) -> None:
        """A target; ``due``: when it is to be reached, None where that is not known."""
        if due is None:
            self.reset()
            self._pose = pose
            return
        last, gap, twist = self._pose, due - self._due, self._twist
        last_position, self._position = self._position, pose.translation.tolist()
        self._pose, self._due = pose, due
        if 0.0 <= gap < _SHORTEST:
            return  # a late tick of its sender, and the next one
        self._twist, self._even = None, False
        if last is None or not _SHORTEST <= gap <= _LONGEST:
            return
        linear = [(there - here) / gap for here, there in zip(last_position, self._position, strict=True)]
        angular = (pin.log3(last.rotation.T @ pose.rotation) / gap).tolist()
        if twist is not None:
            surprise, turn = gap * math.dist(linear, twist[0]), gap * math.dist(angular, twist[1])
            self._even = surprise <= _EVEN and turn <= _EVEN_TURN
        self._gap, self._twist = gap, (linear, angular)

    def at(self, t: float) -> pin.SE3 | None:
        """Where the target is at ``t`` [s]; None where there is none."""
        if self._pose is None or self._twist is None or not self._even:
            return self._pose
        linear, angular = self._twist
        ahead = min(max(t - self._due, -self._gap), _LOOKAHEAD * self._gap)
        position = np.array([at + ahead * speed for at, speed in zip(self._position, linear, strict=True)])
        return pose_of(self._pose.rotation @ pin.exp3(ahead * np.array(angular)), position)
