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
from q2r2_control.robot.turning_fingers import TurningBody, TurningSweeps
from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval


@dataclass(frozen=True, slots=True)
class FingerSlide:
    """A finger joint as it moves one end of a finger along the body's line."""

    along: float  # way along the line per way of the joint, -1 .. 1
    home: float  # position of the joint where the body was drawn [m]
    closed: float  # positions of the closed and of the open gripper [m]
    open: float
    lower: float  # limits of the joint [m]
    upper: float

    def way(self, interval: Interval) -> tuple[float, float]:
        """Least and greatest way along the line, from home, at openings in ``interval`` [m].

        An interval that begins at 0 begins at the end of the joint's travel, which may be beyond the closed gripper; so
        at 1 and the open one.
        """
        before_closed, beyond_open = (self.lower, self.upper) if self.open > self.closed else (self.upper, self.lower)
        first = before_closed if interval[0] <= 0.0 else self._position(interval[0])
        last = beyond_open if interval[1] >= 1.0 else self._position(interval[1])
        ways = self.along * (first - self.home), self.along * (last - self.home)
        return min(ways), max(ways)

    def _position(self, opening: float) -> float:
        return self.closed + opening * (self.open - self.closed)


@dataclass(frozen=True, slots=True)
class FingerBody:
    """A body that is all of the way of one arm's fingers along a line, and what of them is where on it."""

    arm: str
    name: str  # of the geometry
    length: float  # of its segment [m]
    ends: tuple[
        tuple[float, tuple[FingerSlide, ...]], ...
    ]  # along the segment at home [m], and the joints that move them

    def part(self, interval: Interval) -> tuple[float, float]:
        """Which part of the segment, from 0 its start to 1 its end, the fingers are in at openings in ``interval``."""
        if interval == ALL_OF_THE_WAY:
            return 0.0, 1.0
        least, greatest = self.length, 0.0
        for at, slides in self.ends:
            lowest = highest = at
            for slide in slides:
                down, up = slide.way(interval)
                lowest, highest = lowest + down, highest + up
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
