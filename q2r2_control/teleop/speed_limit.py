"""How fast an arm's target may move, however fast the hand does."""

from __future__ import annotations

import math
from collections.abc import Iterable

from q2r2_control.config.teleop import SpeedLimitSettings
from q2r2_control.quaternions import normalized, turn_between, turned_by
from q2r2_control.types import LONGEST_DT, Pose


class SpeedLimit:
    """Lets a target go where the hand has it at a limited speed.

    A hand that is faster gets ahead. The target comes after it, and by no more than the leash is long: what the hand
    is told from is where the tool would be without this limit, and that is what the leash holds.
    """

    def __init__(self, settings: Iterable[SpeedLimitSettings | None] = (), lever: float = 0.0) -> None:
        """The strictest of ``settings`` counts; of a frame with tools at the ``lever`` [m], for the tools."""
        limits = [limit for limit in settings if limit is not None]
        self._linear = min((limit.linear for limit in limits if limit.linear is not None), default=math.inf)
        self._angular = min((limit.angular for limit in limits if limit.angular is not None), default=math.inf)
        self._lever = lever
        self._any = min(self._linear, self._angular) < math.inf
        self._last: tuple[Pose, float] | None = None

    def reset(self) -> None:
        """For a new anchor: the next target is where the tool is."""
        self._last = None

    def limit(self, target: Pose, now: float) -> Pose:
        """Where the target may be at ``now`` [s], in the frame that it is told in."""
        if not self._any:
            return target
        if self._last is None:
            self._last = target, now
            return target
        ((x, y, z), rotation), before = self._last
        position, turned = target
        dt = min(max(now - before, 0.0), LONGEST_DT)
        a, b, c = turn_between(rotation, turned)
        angle = math.hypot(a, b, c)
        reach = math.dist(position, (x, y, z)) + self._lever * angle
        share = min(
            1.0,
            self._linear * dt / reach if reach > 0.0 else 1.0,
            self._angular * dt / angle if angle > 0.0 else 1.0,
        )
        if share < 1.0:
            to_x, to_y, to_z = position
            # Each is turned from the last one, for as long as the hand is ahead.
            turned = normalized(turned_by(rotation, (share * a, share * b, share * c)))
            target = (x + share * (to_x - x), y + share * (to_y - y), z + share * (to_z - z)), turned
        self._last = target, now
        return target
