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
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import pinocchio as pin

from q2r2_control.events import Reason
from q2r2_control.quaternions import floats_of
from q2r2_control.types import Array, Pose, moved_by

MAX_OFFSET = 0.05, 0.1  # of a tool from its command [m], [rad]


class Anchor(NamedTuple):
    """Where a tool is when its arm is engaged, world frame."""

    tool: pin.SE3  # measured position, commanded orientation
    offset: Array | None = None  # (3,) [m]; None: none


@dataclass(slots=True)  # not frozen: that would cost half a microsecond a tick
class ArmMeasurements:
    """What of the arms themselves counts in one tick; poses are in the world."""

    tools: Mapping[str, pin.SE3]  # measured
    targets: Mapping[str, pin.SE3]  # the last ones
    commanded: Mapping[str, pin.SE3] | None = None  # by the controller's reference
    obstacles: Mapping[str, Reason] = field(default_factory=dict)  # arm -> why it may not be engaged
    in_step: bool = True  # ``commanded`` is of one moment

    def anchor(self, arm: str) -> Anchor | None:
        """The measured position and the commanded orientation, or else that of the last target; None: not known."""
        measured = self.tools.get(arm)
        if measured is None:
            return None
        reference = (self.commanded or self.targets).get(arm, measured)
        tool, commanded = pin.SE3(reference.rotation, measured.translation), (self.commanded or {}).get(arm)
        offset = None if commanded is None else measured.translation - commanded.translation
        return Anchor(tool, offset if offset is not None and math.hypot(*offset) <= MAX_OFFSET[0] else None)

    def expected(self, arm: str, offset: Array | None) -> Pose | None:
        """Where a tool with this offset is to be measured, by what is commanded. None: not known."""
        commanded = None if self.commanded is None else self.commanded.get(arm)
        if commanded is None:
            return None
        (x, y, z), rotation = pose = floats_of(commanded)
        if offset is None:
            return pose
        by_x, by_y, by_z = offset.tolist()
        return (x + by_x, y + by_y, z + by_z), rotation

    def lag(self, arm: str, offset: Array | None) -> float:
        """From where the controller has a tool to its last target [m]."""
        pose, target = self.expected(arm, offset), self.targets.get(arm)
        return 0.0 if pose is None or target is None else math.dist(pose[0], target.translation)


def with_offset(commanded: pin.SE3, offset: Array | None) -> pin.SE3:
    """Where a tool is to be measured that is commanded to be at ``commanded``."""
    return commanded if offset is None else moved_by(commanded, offset)
