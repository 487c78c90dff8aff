"""The fingers' bodies of one collision model, as their grippers' openings are known.

They are changed in place, where the kernels read them. What was worked out once of all of a finger's way stays: its
part is nowhere farther from a joint's axis (``Pairs.reach``, ``leverage``) and fits into a ball of that size about its
own middle (``Bodies.size``), so that every bound made of these holds as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from q2r2_control.control.geometry.collision import Bodies
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.errors import RobotError
from q2r2_control.robot.finger_openings import FingerBody, part_of_segment
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ALL_OF_THE_WAY, Interval


class FingerOpenings:
    """Between which openings the gripper of each arm may be; all of the way, until something else is set."""

    def __init__(self, robot: Robot, bodies: Bodies) -> None:
        """``bodies`` are those of ``robot``, with fingers that are all of their way."""
        self.intervals: dict[str, Interval] = dict.fromkeys(robot.arms, ALL_OF_THE_WAY)
        self._bodies = bodies
        names = [geometry.name for geometry in robot.collision_model.geometryObjects]
        self._fingers: dict[str, list[tuple[int, FingerBody]]] = {arm: [] for arm in robot.arms}
        for finger in robot.finger_bodies:
            self._fingers[finger.arm].append((names.index(finger.name), finger))
        self._start, self._end = bodies.start.copy(), bodies.end.copy()
        self._parts: dict[int, tuple[float, float]] = {}
        self._none: IntArray = np.zeros(len(bodies.joint), dtype=np.int64)

    def checked(self, arm: str, least: float, greatest: float) -> Interval:
        """The interval as it can be set. Raises :class:`RobotError` for no arm and for no interval."""
        if arm not in self._fingers:
            raise RobotError(f"opening of arm {arm!r:.40}: no such arm; arms: {', '.join(self._fingers)}")
        usable = all(isinstance(value, int | float | np.floating) for value in (least, greatest))
        if not (usable and math.isfinite(least) and math.isfinite(greatest) and least <= greatest):
            raise RobotError(
                f"opening of arm {arm} = {least!r:.40} .. {greatest!r:.40}: allowed: finite numbers, the least first"
            )
        return min(max(float(least), 0.0), 1.0), min(max(float(greatest), 0.0), 1.0)

    def set(self, arm: str, interval: Interval) -> IntArray:
        """Make an arm's fingers what they sweep in ``interval``; returns a 1 for each body (g,) that has grown."""
        grown = self._none.copy()
        self.intervals[arm] = interval
        for body, finger in self._fingers[arm]:
            before, part = self._parts.get(body, ALL_OF_THE_WAY), finger.part(interval)
            if part != before:
                self._parts[body] = part
                self._bodies.start[body], self._bodies.end[body] = part_of_segment(
                    self._start[body], self._end[body], part
                )
                grown[body] = part[0] < before[0] or part[1] > before[1]
        return grown

    def set_all(self, intervals: Mapping[str, Interval]) -> None:
        """The same for every arm; one that is not named is all of its way."""
        for arm in self._fingers:
            self.set(arm, intervals.get(arm, ALL_OF_THE_WAY))
