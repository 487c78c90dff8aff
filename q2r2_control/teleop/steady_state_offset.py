"""The steady-state offset: how far a tool is from where it is commanded to be when its arm is engaged.

A load that nothing bears causes it, for example. Targets begin at the measured tool. Were they commanded as they are,
an arm on a spring would give way anew at every engagement. The command therefore keeps the offset that it had:

    command = target - offset,    offset = measured - commanded position at the engagement.

The target then says where the tool is to be measured, and the command stays where it was. The lag of an arm that is
engaged while it moves counts as offset too. It displaces the target alone, until the next engagement. Drives that
follow the reference lag by less than 1 mm at 0.5 m/s.

The offset is bounded. A tool that is farther away was pushed there, or is not moved by this command, and its command
begins at the tool.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import pinocchio as pin

from q2r2_control.quaternions import floats_of
from q2r2_control.types import Array, Pose, moved_by

MAX_OFFSET = 0.05, 0.1  # of a tool from its command [m], [rad]


class Anchor(NamedTuple):
    """Where a tool is when its arm is engaged, world frame."""

    tool: pin.SE3  # measured position, commanded orientation
    offset: Array | None = None  # (3,) [m]; None: none


def anchor_of(measured: pin.SE3, commanded: pin.SE3 | None, rotation: Array) -> Anchor:
    """The anchor of a tool; ``commanded``: by the controller's reference, None: not known; ``rotation`` (3, 3)."""
    tool = pin.SE3(rotation, measured.translation)
    if commanded is None:
        return Anchor(tool)
    offset = measured.translation - commanded.translation
    return Anchor(tool, offset if math.hypot(*offset) <= MAX_OFFSET[0] else None)


def with_offset(commanded: pin.SE3, offset: Array | None) -> pin.SE3:
    """Where a tool is to be measured that is commanded to be at ``commanded``."""
    return commanded if offset is None else moved_by(commanded, offset)


def expected(commanded: pin.SE3, offset: Array | None) -> Pose:
    """The same as :func:`with_offset`, in floats."""
    (x, y, z), rotation = pose = floats_of(commanded)
    if offset is None:
        return pose
    by_x, by_y, by_z = offset.tolist()
    return (x + by_x, y + by_y, z + by_z), rotation
