"""How far a tool is from where it is commanded to be when its arm is engaged, such as by a load that nothing bears.

Targets begin at the measured tool. Were they commanded as they are, the command would move to the tool, and an arm on a
spring would sag anew, at every engagement. So the command keeps the offset that it had from the tool:

    command = target - sag,    sag = measured - commanded position at the engagement.

The target then says where the tool is to be measured, and the command stays where it was. That holds for an arm that is
engaged while it moves, too: its lag counts as sag then, which displaces the target alone, until the next engagement.
Drives that follow the reference lag by less than 1 mm at 0.5 m/s; how far the arm hung where it stood last may differ
by more. A sag is bounded: a tool that is farther away was pushed there, or is not moved by this command, and its
command begins at the tool.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import pinocchio as pin

from q2r2_control.quaternions import floats_of
from q2r2_control.types import Array, Pose, moved_by

# A tool that is farther from its command does not sag [m], [rad].
MOST_SAG = 0.05, 0.1


class Anchor(NamedTuple):
    """Where a tool is when its arm is engaged, world frame."""

    tool: pin.SE3  # measured position, commanded orientation
    sag: Array | None = None  # (3,) [m]; None: none


def anchor_of(measured: pin.SE3, commanded: pin.SE3 | None, rotation: Array) -> Anchor:
    """The anchor of a tool; ``commanded``: by the controller's reference, None: not known; ``rotation`` (3, 3)."""
    tool = pin.SE3(rotation, measured.translation)
    if commanded is None:
        return Anchor(tool)
    sag = measured.translation - commanded.translation
    return Anchor(tool, sag if math.hypot(*sag) <= MOST_SAG[0] else None)


def sagged(commanded: pin.SE3, sag: Array | None) -> pin.SE3:
    """Where a tool is to be measured that is commanded to be at ``commanded``."""
    return commanded if sag is None else moved_by(commanded, sag)


def expected(commanded: pin.SE3, sag: Array | None) -> Pose:
    """The same as :func:`sagged`, in floats."""
    (x, y, z), rotation = pose = floats_of(commanded)
    if sag is None:
        return pose
    by_x, by_y, by_z = sag.tolist()
    return (x + by_x, y + by_y, z + by_z), rotation
