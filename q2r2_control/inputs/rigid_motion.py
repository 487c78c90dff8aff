"""Whether two hands have moved as one rigid body. Human hands do not: they tremble and turn, each on its own."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.inputs.messages import HandPose
from q2r2_control.types import Array

_QUATERNION_LENGTHS = (0.5, 2.0)
_FARTHEST = 1e3  # of a coordinate: no tracking system reaches as far [m]


class Move(NamedTuple):
    """From one place to another: how far [m], and by what angle [rad]."""

    distance: float
    angle: float


class Tolerance(NamedTuple):
    """By how much the place of one hand, seen from the other one, may change."""

    distance: float  # [m]
    angle: float  # [rad]


class Place(NamedTuple):
    """Where one hand is."""

    position: Array  # (3,) [m]
    rotation: Array  # (3, 3)

    @classmethod
    def of(cls, pose: HandPose) -> Place | None:
        """None where the pose is none."""
        quaternion = pose.quaternion
        length = math.sqrt(float(quaternion @ quaternion))
        if not (_QUATERNION_LENGTHS[0] <= length <= _QUATERNION_LENGTHS[1]):
            return None
        if not float(np.abs(pose.position).max()) <= _FARTHEST:
            return None
        return cls(pose.position, pin.Quaternion(quaternion / length).toRotationMatrix())

    def move_from(self, other: Place) -> Move:
        """How it got here from another place."""
        angle = math.hypot(*pin.log3(other.rotation.T @ self.rotation))
        return Move(math.dist(self.position, other.position), angle)


class HandPair(NamedTuple):
    """Both hands at a time, and what a motion of both as one rigid body does not change."""

    t: float  # [s]
    left: Place
    right: Place
    seen: Array  # (3,) the right hand's position in the left hand's axes [m]
    apart: float  # distance of the hands [m]
    turn: Array  # (3, 3) the right hand's rotation in the left hand's axes

    @classmethod
    def of(cls, t: float, left: Place, right: Place) -> HandPair:
        between = right.position - left.position
        return cls(t, left, right, left.rotation.T @ between, math.hypot(*between), left.rotation.T @ right.rotation)


def moved_as_one(before: HandPair, after: HandPair, tolerance: Tolerance) -> bool:
    """Whether what a rigid motion keeps is kept: distance, relative rotation, and the direction to the other hand.

    An angle's tolerance moves the other hand, as seen from this one, by that angle times the distance of the hands. So
    that direction may change by as much; a smaller bound would demand less noise of the rotations than is allowed.
    """
    if abs(after.apart - before.apart) > tolerance.distance:
        return False
    if math.dist(after.seen, before.seen) > tolerance.distance + tolerance.angle * after.apart:
        return False
    return bool(cosine_of(before.turn, after.turn) >= math.cos(tolerance.angle))


def cosine_of(before: Array, after: Array) -> float:
    """Cosine of the angle between two rotations (3, 3)."""
    return 0.5 * (float(np.vdot(before, after)) - 1.0)
