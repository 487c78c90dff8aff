"""Touches in the simulated cell: which fingers hold which parts, and whether arms touch anything else.

Judged from MuJoCo's contacts alone, whatever the controller believes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot


class Toucher(IntFlag):
    """Bodies that may touch a part."""

    NOTHING = 0
    SURROUNDINGS = 1  # table, floor, and whatever else stands still
    PART = 2
    ARM = 4  # of either arm all but its fingers
    LEFT_FINGER = 8
    RIGHT_FINGER = 16


FINGERS = Toucher.LEFT_FINGER | Toucher.RIGHT_FINGER
_FINGERS_OF = {"left": Toucher.LEFT_FINGER, "right": Toucher.RIGHT_FINGER}
_ROBOT = Toucher.ARM | FINGERS


@dataclass(frozen=True, slots=True)
class PartState:
    """One loose part at one time."""

    place: tuple[float, float, float]  # of its centre in the world [m]
    tilt: float  # of its own z axis from the world's [rad]
    touched: int  # by what, as :class:`Toucher`


class TouchWatch:
    """Looks at loose parts of a simulated cell, and remembers every touch of an arm that is not a grasp.

    Called at every tick of the control loop: plain numbers in Python cost less here than arrays.
    """

    def __init__(self, plant: MujocoPlant, robot: Robot, parts: Sequence[str], objects: Sequence[str]) -> None:
        """``parts`` are looked at, ``objects`` are all that fingers may touch; names of ``mujoco.objects``."""
        self._model, self._data = plant.model, plant.data
        loose = {self._model.body(name).id for name in objects}
        self._parts = {name: int(self._model.body(name).id) for name in parts}
        bodies: list[int] = self._model.geom_bodyid.tolist()
        self._body = bodies
        self._kinds = [int(Toucher.PART if body in loose else self._kind(body, robot)) for body in bodies]
        self._is_grasp = [not both & _ROBOT or (both & ~FINGERS) == Toucher.PART for both in range(2 * max(Toucher))]
        self.forbidden: dict[tuple[str, str], float] = {}  # names of two bodies -> when they touched first [s]

    def look(self, t: float) -> dict[str, PartState]:
        """Every part at ``t`` [s], as of the last physics step."""
        touched = dict.fromkeys(self._body, 0)
        kinds, body = self._kinds, self._body
        for first, second in self._data.contact.geom.tolist():
            one, other = kinds[first], kinds[second]
            touched[body[first]] |= other
            touched[body[second]] |= one
            # A finger may touch a part; nothing else of an arm may touch anything, itself and the other arm included.
            if not self._is_grasp[one | other]:
                pair = self._model.body(body[first]).name, self._model.body(body[second]).name
                self.forbidden.setdefault(pair, t)
        places, rotations = self._data.xpos, self._data.xmat
        return {
            name: PartState(tuple(places[part].tolist()), math.acos(min(rotations[part, 8], 1.0)), touched[part])
            for name, part in self._parts.items()
        }

    def _kind(self, body: int, robot: Robot) -> Toucher:
        """Of what is no part: by the joints that move it, from its own up to the world's."""
        above = body
        while above:
            for arm, finger in _FINGERS_OF.items():
                if arm in robot.arms and self._is_moved_by(above, robot.arms[arm].finger_joints):
                    return finger
            if self._is_moved_by(above, robot.joint_names):
                return Toucher.ARM
            above = int(self._model.body_parentid[above])
        is_base = self._model.body(body).name.startswith(tuple(f"{arm}_" for arm in robot.arms))
        return Toucher.ARM if is_base else Toucher.SURROUNDINGS

    def _is_moved_by(self, body: int, joints: tuple[str, ...]) -> bool:
        first, count = int(self._model.body_jntadr[body]), int(self._model.body_jntnum[body])
        return any(self._model.joint(joint).name in joints for joint in range(first, first + count))
