"""Fit the bodies of fingers in a collision model to the known openings of their grippers.

The arrays of the bodies are changed in place, where the kernels read them. The body of a sliding finger is the part of
its path that belongs to the known openings. This part is nowhere farther from a joint's axis than the whole path
(``Pairs.reach``, ``leverage``). It also fits into a ball of the same size about its own middle
(``CollisionBodies.size``). Every bound that uses these numbers therefore stays valid. A turning finger has a separate
capsule, radius and size for each interval of openings. Its ``reach`` and ``leverage`` come from the capsule that
reaches farthest (``collision_model_of``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from q2r2_control.control.geometry.collision import CollisionBodies, turning_bodies
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.errors import RobotError, shown
from q2r2_control.robot.finger_bodies import FingerBody, part_of_segment
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turning_fingers import Capsules, TurningBody, TurningSweeps, sticks_out
from q2r2_control.types import ALL_OF_THE_WAY, Interval

# Number of intervals whose capsules are kept. A gripper that does not move needs the same intervals again and again.
_REMEMBERED = 16


class FingerOpenings:
    """The interval of openings of each arm's gripper. At first, it is the whole interval from closed to open."""

    def __init__(self, robot: Robot, bodies: CollisionBodies) -> None:
        """Begin with the ``bodies`` of ``robot``. At first, the body of each finger covers the finger's whole path."""
        self.intervals: dict[str, Interval] = dict.fromkeys(robot.arms, ALL_OF_THE_WAY)
        self._bodies = bodies
        names = [geometry.name for geometry in robot.collision_model.geometryObjects]
        self._fingers: dict[str, list[tuple[int, FingerBody]]] = {arm: [] for arm in robot.arms}
        for finger in robot.finger_bodies:
            if isinstance(finger, FingerBody):
                self._fingers[finger.arm].append((names.index(finger.name), finger))
        turning: dict[str, list[tuple[int, TurningBody]]] = {}
        for number, turned in turning_bodies(robot):
            turning.setdefault(turned.arm, []).append((number, turned))
        self._turning = {arm: _Turning(found, bodies) for arm, found in turning.items()}
        self._start, self._end = bodies.start.copy(), bodies.end.copy()
        self._parts: dict[int, tuple[float, float]] = {}

    def checked(self, arm: str, least: float, greatest: float) -> Interval:
        """Return the interval, clamped to [0, 1], for :meth:`set`; raises :class:`RobotError` if it is no interval."""
        usable = all(isinstance(value, int | float | np.floating) for value in (least, greatest))
        if not (usable and -math.inf < least <= greatest < math.inf):
            raise RobotError(
                f"opening of arm {arm} = {shown(least)} .. {shown(greatest)}: allowed: finite numbers, the least first"
            )
        return float(min(max(least, 0.0), 1.0)), float(min(max(greatest, 0.0), 1.0))

    def set(self, arm: str, interval: Interval) -> IntArray:
        """Let the bodies of an arm's fingers cover ``interval``. Return 1 for each body that has grown, else 0 (g,).

        A body has grown if it is not within its former volume. A sliding finger grows only if the interval gets wider.
        A turning finger may also grow if the interval gets narrower.
        """
        grown: IntArray = np.zeros(len(self._bodies.joint), dtype=np.int64)
        self.intervals[arm] = interval
        for body, finger in self._fingers[arm]:
            before, part = self._parts.get(body, ALL_OF_THE_WAY), finger.part(interval)
            if part != before:
                self._parts[body] = part
                self._bodies.start[body], self._bodies.end[body] = part_of_segment(
                    self._start[body], self._end[body], part
                )
                grown[body] = part[0] < before[0] or part[1] > before[1]
        if arm in self._turning:
            self._turning[arm].set(interval, grown)
        return grown

    @property
    def turn(self) -> bool:
        """True if some fingers turn, so that radii change too."""
        return bool(self._turning)

    def set_all(self, intervals: Mapping[str, Interval]) -> None:
        """Set the interval of every arm. An arm that is not named gets the whole interval."""
        for arm in self._fingers:
            self.set(arm, intervals.get(arm, ALL_OF_THE_WAY))


class _Turning:
    """The turning fingers of one arm, with separate capsules for each interval."""

    def __init__(self, found: Sequence[tuple[int, TurningBody]], bodies: CollisionBodies) -> None:
        self._bodies, self._indices = bodies, np.array([index for index, _ in found])
        self._all = self._now()
        self._capsules = lru_cache(maxsize=_REMEMBERED)(TurningSweeps([body for _, body in found]).capsules)

    def set(self, interval: Interval, grown: IntArray) -> None:
        """Set the capsules for ``interval``. In ``grown`` (g,), mark bodies that are not within their last volume."""
        bodies, at = self._bodies, self._indices
        capsules = self._all if interval == ALL_OF_THE_WAY else self._capsules(interval)
        changed = sticks_out(capsules, self._now())
        bodies.start[at], bodies.end[at], bodies.radius[at] = capsules
        bodies.size[at] = 0.5 * np.linalg.norm(capsules.end - capsules.start, axis=1) + capsules.radius
        grown[at] = changed

    def _now(self) -> Capsules:
        bodies, at = self._bodies, self._indices
        return Capsules(bodies.start[at].copy(), bodies.end[at].copy(), bodies.radius[at].copy())
