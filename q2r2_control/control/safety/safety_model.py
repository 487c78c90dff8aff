"""What the safety kernels know of a robot and its settings."""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.control.geometry.collision import CollisionModel
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.safety.joint_limits import JointLimits
from q2r2_control.types import Array

# A pair that is closer than its distance by less than this is not too close: a difference of distances has no more
# digits. Its proof then is that it comes no closer than it is, see stop_certificate.py.
ROUNDING = 1e-9  # [m]


class Approach(NamedTuple):
    """How pairs may approach each other in the QP."""

    stop_distance: Array  # (p,) min_distance + buffer [m]
    gain: Array  # (1,), which may change between ticks, see separation_rows.py [1/s]
    contact_speed: Array  # (p,) of pairs that may touch, in the contact zone [m/s]; of the others infinite
    contact_zone: Array  # (p,) free distance from which on that holds [m]; of the others 0
    recovery_speed: float  # [m/s]


class SafetyModel(NamedTuple):
    """What does not change in a tick; between ticks bodies of fingers, kept distances and the rows' gain may."""

    collision: CollisionModel
    limits: JointLimits
    approach: Approach
    min_distance: Array  # (p,) of every pair [m]; minus infinity: it does not count now
    arm: IntArray  # (nv,) number of the arm that a joint belongs to; joints of none share the last number
