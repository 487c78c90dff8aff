"""The box that an operator's targets stay in, with an edge that is felt before it is reached.

Within the soft edge e of a side, a step of the hand outwards moves the target by the share of the edge that is left:
dx = (r / e) dh with the room r to the side, so that r shrinks as exp(-h / e) and never to nothing, whatever the ticks
are. What the hand goes beyond that slips, as on a leash: when the hand comes back, the target does so at once.

A hand that trembles goes out and back all the time. If it went out slowly and came back fast, its target would creep
away from the side. So the target goes back as slowly as it went out until the hand has turned by more than tremor,
and goes out as fast as it came back until the hand has turned again.
"""

from __future__ import annotations

import math
from itertools import starmap

from q2r2_control.config.teleop import WorkspaceSettings
from q2r2_control.quaternions import Vector
from q2r2_control.types import Pose

_TURNED = 1.5e-3  # the hand has turned, and does not only tremble [m]


class Workspace:
    """Keeps one arm's targets in its box; None: there is no box.

    Outside of the box, where a tool may be when its arm is engaged, the target goes inwards only.
    """

    def __init__(self, settings: WorkspaceSettings | None) -> None:
        self._axes: list[_Axis] = []
        if settings is not None:
            self._axes = [_Axis(*side, settings.soft_edge) for side in (settings.x, settings.y, settings.z)]
        self._last: Vector | None = None
        self.slip = 0.0  # how much of the hand's way was not made since the reset [m]

    def reset(self) -> None:
        """For a new anchor: the next target is where the tool is, wherever that may be."""
        self._last, self.slip = None, 0.0

    def hold(self, target: Pose) -> Vector | None:
        """Where a target that is asked to be at ``target``, world frame, may be; None: there.

        Asked at every tick; what it returns the hand has to be anchored to.
        """
        if not self._axes:
            return None
        asked = target[0]
        last, self._last = self._last, asked
        if last is None:
            for axis, value in zip(self._axes, asked, strict=True):
                axis.begin(value)
            return None
        x, y, z = starmap(_Axis.step, zip(self._axes, last, asked, strict=True))
        allowed = x, y, z
        if allowed == asked:
            return None
        self.slip += math.dist(allowed, asked)
        self._last = allowed
        return allowed

    def clip(self, position: Vector) -> Vector:
        """The nearest position within the sides, world frame [m]."""
        if not self._axes:
            return position
        x, y, z = map(_Axis.clip, self._axes, position)
        return x, y, z

    def move_to(self, position: Vector) -> None:
        """The target is at ``position`` [m] instead of what :meth:`hold` returned last."""
        if self._last is not None:
            self._last = position


class _Axis:
    """One axis of the box, between two sides."""

    def __init__(self, least: float, greatest: float, edge: float) -> None:
        self._least, self._greatest, self._edge = least, greatest, edge
        self._free = True  # steps are made whole, since the hand comes back, or is away from the sides
        self._turned = 0.0  # by how much the hand goes the other way [m]

    def begin(self, value: float) -> None:
        self._free, self._turned = self._least <= value <= self._greatest, 0.0

    def clip(self, value: float) -> float:
        return min(max(value, self._least), self._greatest)

    def step(self, start: float, end: float) -> float:
        """Where a step of the hand from ``start`` towards ``end`` leads."""
        upper = self._greatest - start < start - self._least
        room = self._greatest - start if upper else start - self._least
        if room >= self._edge + abs(end - start):
            self._free, self._turned = True, 0.0
            return end
        out = end - start if upper else start - end
        self._turned = max(self._turned + (out if self._free else -out), 0.0)
        if self._turned > _TURNED:
            self._free, self._turned = not self._free, 0.0
        made = out if self._free else out * min(max(room / self._edge, 0.0), 1.0)
        if made == out and (room < 0.0 or made <= room) and self._least <= end <= self._greatest:
            return end
        reached = start + (made if upper else -made)
        return reached if room < 0.0 else self.clip(reached)
