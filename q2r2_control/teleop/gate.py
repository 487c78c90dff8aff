"""Check every pose of a hand before it may move an arm."""

from __future__ import annotations

import math
from collections import deque
from operator import mul

import numpy as np

from q2r2_control.config.teleop import GateSettings
from q2r2_control.events import Reason
from q2r2_control.quaternions import Quaternion
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HandSample, Pose

_MAX_COORDINATE = 1e6  # No tracking system measures such a large coordinate [m].
_QUATERNION_LENGTHS = (1e-6, 1e6)  # A quaternion with a length outside this range counts as no rotation.
# Least time over which a speed is measured [s]. Messages that a network has delayed arrive less than 1 ms apart. A
# speed that is computed from two such messages would be far too high.
_SPEED_WINDOW = 0.05


class PoseGate:
    """Accepts the usable poses of one hand, and gives the reason why another pose is not usable.

    All times are times of receipt. A stamp later than ``now`` counts as ``now``, so that it cannot disable the
    watchdog. A sample that is older than the last one is ignored, because a newer message has overtaken it.
    """

    def __init__(self, settings: GateSettings) -> None:
        self.settings = settings
        self.reset()

    def reset(self) -> None:
        # The newest pose, in the input's frame; None if there is none, or if it was not usable.
        self.pose: Pose | None = None
        self.stamp = -math.inf  # Time of the newest pose, usable or not [s].
        self._problem: Reason | None = None
        self._recent: deque[tuple[float, Pose]] = deque()  # Times [s] and poses. The oldest is about _SPEED_WINDOW old.

    @property
    def problem(self) -> Reason | None:
        """Why an arm may not be anchored to the newest pose; None if it may."""
        return None if self.pose is not None else self._problem or Reason(TeleopReason.NO_POSE)

    def stale(self, now: float) -> bool:
        """Return whether no pose, usable or not, was received for longer than the timeout of the settings."""
        return now - self.stamp > self.settings.timeout

    def receive(self, sample: HandSample, now: float) -> tuple[bool, Reason | None]:
        """Judge the pose of a sample.

        Returns:
            Two values. The first is True if the pose is new and usable, so that an arm may be anchored to it. The
            second is the reason why an engaged arm must not follow the pose, or None. After a jump the pose is usable
            and there is a reason: the arm must not follow the jump, but may be anchored to the new pose.
        """
        stamp = min(float(sample.pose_stamp), now)
        if math.isnan(stamp):
            return False, Reason(TeleopReason.POSE_WITHOUT_STAMP)
        if stamp < self.stamp or stamp == -math.inf:
            return False, None
        self._problem = None if sample.fault is None else Reason(TeleopReason(sample.fault.value))
        pose = pose_of(sample) if self._problem is None else None
        previous, gap = self.pose, stamp - self.stamp
        self.pose, self.stamp = pose, stamp
        if pose is None:
            self._recent.clear()
            return False, self._problem or Reason(TeleopReason.POSE_UNUSABLE)
        if jump := None if previous is None else self._jump(previous, pose, gap):
            self._recent.clear()  # Earlier poses are forgotten, so that no speed is measured across the jump.
        return True, jump or self._speed(pose, stamp)

    def _jump(self, previous: Pose, pose: Pose, gap: float) -> Reason | None:
        limits = self.settings
        if gap > limits.timeout:
            return Reason.of(TeleopReason.POSE_GAP, gap=gap)
        distance = math.dist(pose[0], previous[0])
        if distance > limits.max_jump:
            return Reason.of(TeleopReason.HAND_JUMPED, distance=distance)
        angle = _angle(previous[1], pose[1])
        if angle > limits.max_rotation_jump:
            return Reason.of(TeleopReason.HAND_ROTATION_JUMPED, angle=angle)
        return None

    def _speed(self, pose: Pose, stamp: float) -> Reason | None:
        """Return a fault if the hand's mean speed over the last ``_SPEED_WINDOW`` is too high, else None."""
        recent = self._recent
        recent.append((stamp, pose))
        while len(recent) > 1 and stamp - recent[1][0] >= _SPEED_WINDOW:
            recent.popleft()
        since, start = recent[0]
        time = stamp - since
        if time < _SPEED_WINDOW:
            return None
        speed = math.dist(pose[0], start[0]) / time
        if speed > self.settings.max_speed:
            return Reason.of(TeleopReason.HAND_TOO_FAST, speed=speed)
        angular_speed = _angle(start[1], pose[1]) / time
        if angular_speed > self.settings.max_angular_speed:
            return Reason.of(TeleopReason.HAND_TURNS_TOO_FAST, speed=angular_speed)
        return None


def pose_of(sample: HandSample) -> Pose | None:
    """Return the sample's pose with a unit quaternion, or None if it is not usable."""
    position, quaternion = _numbers(sample.position, 3), _numbers(sample.quaternion, 4)
    if position is None or quaternion is None or max(map(abs, position)) > _MAX_COORDINATE:
        return None
    length = math.hypot(*quaternion)
    if not _QUATERNION_LENGTHS[0] <= length <= _QUATERNION_LENGTHS[1]:
        return None
    (x, y, z), (a, b, c, w) = position, quaternion
    return (x, y, z), (a / length, b / length, c / length, w / length)


def _numbers(values: object, size: int) -> list[float] | None:
    try:
        vector = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    numbers: list[float] = vector.tolist()
    return numbers if vector.shape == (size,) and all(map(math.isfinite, numbers)) else None


def _angle(one: Quaternion, other: Quaternion) -> float:
    """Return the angle between two unit quaternions [rad], with an error of up to 1e-7 near zero."""
    return 2.0 * math.acos(min(abs(sum(map(mul, one, other))), 1.0))
