"""Find a left and a right controller that the operator has swapped."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from q2r2_control.config.teleop import axes_matrix
from q2r2_control.events import Reason
from q2r2_control.quaternions import se3_of
from q2r2_control.teleop.gate import pose_of
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, Array, HandSample
from q2r2_control.wording import sentence

CROSSED_FOR = 3.0  # The hands count as crossed after this time without a moment in which they were not [s].
CROSSED = Reason.of(TeleopReason.HANDS_CROSSED, time=CROSSED_FOR)
_BY = 0.1  # Distance to the wrong side from which on a moment counts [m].
_AGREES = 0.5  # Least cosine between the pointing direction of each controller and that of both together.
_NEWEST = 0.2  # A pose that is older does not count [s].


class CrossedHands:
    """Watches on which side of each other both hands are, in the frame of the operator.

    Nobody tells where the operator faces, so the controllers do: both point forward, along the x axis of their own
    frames, and their mean horizontal direction is the operator's forward direction. The distance of the left hand from
    the right one along the operator's left is negative if the hands are crossed.

    Hands that cross in ordinary work do so for moments, or at less than 10 cm, or turn their controllers apart. Such
    moments begin the time of 3 s anew, and so does a moment in which one hand is not tracked. Swapped controllers stay
    on the wrong side from the beginning. The result is a warning only, since an operator may also cross the arms on
    purpose.
    """

    def __init__(self, axes: Sequence[str]) -> None:
        """``axes`` are those of ``teleop.axes``."""
        self._axes: Array = axes_matrix(axes)
        self._hands: dict[str, tuple[float, Array, Array]] = {}  # By hand: time [s], position [m], pointing direction.
        self._since = math.inf  # Since when the hands have been crossed [s].
        self._at = -math.inf  # Time of the newest moment that was judged [s].

    def add(self, sample: HandSample) -> None:
        """Take a sample of either hand. A pose that cannot be used counts as a hand that is not tracked."""
        stamp, pose = float(sample.pose_stamp), pose_of(sample)
        if sample.fault is not None or pose is None or not math.isfinite(stamp):
            self._hands.pop(sample.hand, None)
            self._since = math.inf
            return
        placement = se3_of(pose)
        points = self._axes @ placement.rotation @ self._axes.T[:, 0]
        self._hands[sample.hand] = stamp, self._axes @ placement.translation, points
        if stamp - self._at > _NEWEST:  # Nobody has seen both hands meanwhile.
            self._since = math.inf
        if self._hands.keys() == {*SIDES}:
            self._judge(stamp)

    def crossed(self, now: float) -> bool:
        """Return whether the hands have been crossed for :data:`CROSSED_FOR` until ``now`` [s]."""
        return now - self._at <= _NEWEST and self._at - self._since >= CROSSED_FOR

    def warning(self, now: float) -> str | None:
        """Return the sentence about crossed hands at ``now`` [s], or None if they are not crossed."""
        return sentence(CROSSED) if self.crossed(now) else None

    def _judge(self, stamp: float) -> None:
        (left_at, left, left_points), (right_at, right, right_points) = (self._hands[hand] for hand in SIDES)
        if abs(left_at - right_at) > _NEWEST:
            self._since = math.inf
            return
        self._at = stamp
        forward = (left_points + right_points)[:2]
        length = float(np.linalg.norm(forward))
        if length > 0.0:
            forward = forward / length
        agree = all(float(points[:2] @ forward) >= _AGREES for points in (left_points, right_points))
        leftwards = (left - right)[:2] @ np.array([-forward[1], forward[0]])
        if not agree or leftwards > -_BY:
            self._since = math.inf
        else:
            self._since = min(self._since, stamp)
