"""What the safety kernels know of a robot and its settings."""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.control.geometry.collision import CollisionModel
from q2r2_control.control.safety.joint_limits import JointLimits


class Approach(NamedTuple):
    """How pairs may approach each other in the QP."""

    stop_distance: float  # min_distance + buffer [m]
    gain: float  # [1/s]
    recovery_speed: float  # [m/s]
    slow_below: float  # distance at which round pairs begin to slow the arms down [m]


class SafetyModel(NamedTuple):
    """What does not change between ticks."""

    collision: CollisionModel
    limits: JointLimits
    approach: Approach
    min_distance: float  # of every pair [m]
