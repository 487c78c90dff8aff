"""The box that an operator's targets stay in.

A target stops at a side of the box, and what the hand goes beyond it slips, as on a leash: a hand that comes back moves
its target at once.
"""

from __future__ import annotations

import math

from q2r2_control.config.teleop import WorkspaceSettings
from q2r2_control.quaternions import Vector
from q2r2_control.types import Interval, Pose


class Workspace:
    """Keeps one arm's targets in its box; None: there is no box.

    A tool may be outside when its arm is engaged. Then the target goes no farther out than that.
    """

    def __init__(self, settings: WorkspaceSettings | None) -> None:
        self._sides: tuple[Interval, ...] = () if settings is None else (settings.x, settings.y, settings.z)
        self.reset()

    def reset(self) -> None:
        """For a new anchor: the next target is where the tool is, wherever that may be."""
        self._bounds: list[Interval] | None = None
        self.slip = 0.0  # how much of the hand's way was not made since the reset [m]

    def hold(self, target: Pose) -> Vector | None:
        """Where a target that is asked to be at ``target``, world frame, may be; None: there.

        Asked at every tick; what it returns the hand has to be anchored to.
        """
        asked = target[0]
        if self._bounds is None:
            self._bounds = [(min(side[0], at), max(side[1], at)) for side, at in zip(self._sides, asked, strict=False)]
        allowed = self.clip(asked)
        if allowed == asked:
            return None
        self.slip += math.dist(allowed, asked)
        return allowed

    def clip(self, position: Vector) -> Vector:
        """The nearest position that a target may have, world frame [m]."""
        if not self._bounds:
            return position
        x, y, z = (min(max(at, least), greatest) for (least, greatest), at in zip(self._bounds, position, strict=True))
        return x, y, z
