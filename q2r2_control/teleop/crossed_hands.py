"""Find out whether the operator has swapped the left and the right controller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul

from q2r2_control.config.teleop import axes_matrix
from q2r2_control.events import Reason
from q2r2_control.quaternions import inverse, product
from q2r2_control.teleop.gate import pose_of
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, HandSample
from q2r2_control.wording import sentence

CROSSED_FOR = 3.0  # The hands count as crossed if they were crossed at every moment of this time [s].
CROSSED = Reason.of(TeleopReason.HANDS_CROSSED, time=CROSSED_FOR)
_BY = 0.1  # Hands are crossed if each is on the wrong side of the other by at least this distance [m].
_AGREES = 0.5  # Least cosine between each controller's pointing direction and the mean direction of both.
_Level = tuple[float, float]  # The x and y parts of a vector, in world axes.
_NEWEST = 0.2  # A pose that is older than this does not count [s].


class CrossedHands:
    """Watches whether the left hand is to the left of the right hand, as the operator sees them.

    The samples do not say where the operator faces, so the controllers have to show it. Each controller points forward
    along the x axis of its own frame. The mean horizontal direction of both controllers counts as the operator's
    forward direction. The displacement from the right hand to the left hand, measured towards the operator's left, is
    negative if the hands are crossed.

    In ordinary work, hands cross only for moments, or by less than 10 cm, or with controllers that point in different
    directions. After such a moment, the 3 s begin again. They also begin again if one hand is not tracked. Swapped
    controllers stay on the wrong side from the beginning. The result is only a warning, since an operator may also
    cross the arms on purpose.
    """

    def __init__(self, axes: Sequence[str]) -> None:
        """``axes`` are the signed axes of the setting ``teleop.axes``, from the input's frame to the world frame."""
        self._forward, self._left = axes_matrix(axes)[:2].tolist()  # The world's x and y axes, in the input's frame.
        # For each hand: time [s], and the horizontal parts of its position [m] and of its pointing direction.
        self._hands: dict[str, tuple[float, _Level, _Level]] = {}
        self._since = math.inf  # Time since which the hands have been crossed [s]; infinite if they are not crossed.
        self._at = -math.inf  # Time of the newest sample at which both hands were judged [s].

    def add(self, sample: HandSample) -> None:
        """Take a sample of either hand. A pose that cannot be used counts as a hand that is not tracked."""
        stamp, pose = float(sample.pose_stamp), pose_of(sample)
        if sample.fault is not None or pose is None or not math.isfinite(stamp):
            self._hands.pop(sample.hand, None)
            self._since = math.inf
            return
        position, rotation = pose
        *points, _ = product(product(rotation, (*self._forward, 0.0)), inverse(rotation))
        self._hands[sample.hand] = stamp, self._level(position), self._level(points)
        if stamp - self._at > _NEWEST:  # The last judgement of both hands is too old.
            self._since = math.inf
        if self._hands.keys() == {*SIDES}:
            self._judge(stamp)

    def crossed(self, now: float) -> bool:
        """Return whether the hands are crossed at ``now`` and were so for at least :data:`CROSSED_FOR` [s]."""
        return now - self._at <= _NEWEST and self._at - self._since >= CROSSED_FOR

    def warning(self, now: float) -> str | None:
        """Return the sentence about crossed hands at ``now`` [s], or None if they are not crossed."""
        return sentence(CROSSED) if self.crossed(now) else None

    def _level(self, vector: Sequence[float]) -> _Level:
        """Return the x and y parts, in world axes, of a vector in the input's frame."""
        return sum(map(mul, self._forward, vector)), sum(map(mul, self._left, vector))

    def _judge(self, stamp: float) -> None:
        (left_at, left, left_points), (right_at, right, right_points) = (self._hands[hand] for hand in SIDES)
        if abs(left_at - right_at) > _NEWEST:
            self._since = math.inf
            return
        self._at = stamp
        x, y = left_points[0] + right_points[0], left_points[1] + right_points[1]
        if (length := math.hypot(x, y)) > 0.0:
            x, y = x / length, y / length
        agree = all(points[0] * x + points[1] * y >= _AGREES for points in (left_points, right_points))
        leftwards = (left[1] - right[1]) * x - (left[0] - right[0]) * y
        if not agree or leftwards > -_BY:
            self._since = math.inf
        else:
            self._since = min(self._since, stamp)
