"""What a sliding finger sweeps while its gripper's opening is known to be in an interval: a part of all of its way.

An opening is 0 closed .. 1 fully open. The body of finger_bodies.py is a segment with a radius, along which every point
of the finger moves: where the opening is known, the finger is in a part of it. Parts of an interval within another one
are within its parts, so that a body only ever shrinks as more is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import pinocchio as pin

from q2r2_control.robot.enclose import capsule_between
from q2r2_control.robot.turning_fingers import FingerJoint, TurningBody, TurningSweeps
from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval


@dataclass(frozen=True, slots=True)
class FingerBody:
    """A body that is all of the way of one arm's fingers along a line, and what of them is where on it."""

    arm: str
    name: str  # of the geometry
    length: float  # of its segment [m]
    # Places along the segment at home [m], and the joints that move each, with the part of their way along the line.
    ends: tuple[tuple[float, tuple[tuple[float, FingerJoint], ...]], ...]

    def part(self, interval: Interval) -> tuple[float, float]:
        """Which part of the segment, from 0 its start to 1 its end, the fingers are in at openings in ``interval``."""
        if interval == ALL_OF_THE_WAY:
            return 0.0, 1.0
        least, greatest = self.length, 0.0
        for at, slides in self.ends:
            lowest = highest = at
            for along, joint in slides:
                ways = [along * (position - joint.home) for position in joint.travel(interval)]
                lowest, highest = lowest + min(ways), highest + max(ways)
            least, greatest = min(least, lowest), max(greatest, highest)
        return max(least / self.length, 0.0), min(greatest / self.length, 1.0)


def part_of_segment(start: Array, end: Array, part: tuple[float, float]) -> tuple[Array, Array]:
    """Both ends (3,) of a part of the segment from ``start`` to ``end`` (3,); all of it is exact."""
    along = end - start
    return start + part[0] * along, end - (1.0 - part[1]) * along


def collision_model_at(
    geometry: pin.GeometryModel, fingers: Iterable[FingerBody | TurningBody], openings: Mapping[str, Interval]
) -> pin.GeometryModel:
    """A copy of ``Robot.collision_model`` with fingers as they are at ``openings`` by arm, others all of their way."""
    made, bodies = geometry.copy(), list(fingers)
    for body in bodies:
        interval = openings.get(body.arm, ALL_OF_THE_WAY)
        if isinstance(body, FingerBody) and interval != ALL_OF_THE_WAY:
            item = made.geometryObjects[made.getGeometryId(body.name)]
            half = item.geometry.halfLength * item.placement.rotation[:, 2]
            middle = item.placement.translation
            start, end = part_of_segment(middle - half, middle + half, body.part(interval))
            item.geometry, item.placement = capsule_between(float(item.geometry.radius), start, end)
    for arm, interval in openings.items():
        # All of an arm's at once, as the kernels have them: how many samples are taken is a matter of all of them.
        turning = [body for body in bodies if isinstance(body, TurningBody) and body.arm == arm]
        if turning and interval != ALL_OF_THE_WAY:
            for body, *capsule in zip(turning, *TurningSweeps(turning).capsules(interval), strict=True):
                item = made.geometryObjects[made.getGeometryId(body.name)]
                item.geometry, item.placement = capsule_between(float(capsule[2]), capsule[0], capsule[1])
    return made
