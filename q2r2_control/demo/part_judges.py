"""Judges of simulated tasks. They look only at the parts, so an operator is judged in the same way as a script."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from q2r2_control.robot.robot import Robot

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco import MujocoPlant


class Toucher:
    """Kinds of bodies that can touch a part, as flags."""

    NOTHING = 0
    SURROUNDINGS = 1  # The table, the floor, and everything else that stands still.
    PART = 2
    ARM = 4  # Either arm without its fingers.
    LEFT_FINGER = 8
    RIGHT_FINGER = 16


FINGERS = Toucher.LEFT_FINGER | Toucher.RIGHT_FINGER
_FINGERS_OF = {"left": Toucher.LEFT_FINGER, "right": Toucher.RIGHT_FINGER}
_ROBOT = Toucher.ARM | FINGERS


@dataclass(frozen=True, slots=True)
class PartState:
    """One loose part at one time."""

    place: tuple[float, float, float]  # The position of the part's centre in the world [m].
    tilt: float  # The angle between the part's z axis and the world's z axis [rad].
    touched: int  # The bodies that touch the part, as flags of :class:`Toucher`.
    pressed: float = 0.0  # The force on the surroundings, if it is measured [N].


class TouchWatch:
    """Looks at loose parts of a simulated cell, and remembers every touch of an arm that is not a grasp."""

    def __init__(
        self,
        plant: MujocoPlant,
        robot: Robot,
        parts: Sequence[str],
        objects: Sequence[str],
        pressed: Sequence[str] = (),
    ) -> None:
        """Watch ``parts``, and measure the force on the parts in ``pressed``. Fingers may touch all ``objects``.

        All are names of ``mujoco.objects``.
        """
        import mujoco  # The import is here, because tasks can be listed without MuJoCo.

        self._model, self._data = plant.model, plant.data
        self._contact_force = partial(mujoco.mj_contactForce, self._model, self._data)
        loose = {self._model.body(name).id for name in objects}
        self._parts = {name: int(self._model.body(name).id) for name in parts}
        self._pressed = {self._parts[name] for name in pressed}
        self._wrench = np.zeros(6)  # The wrench of one contact, with the normal force first.
        self._body: list[int] = self._model.geom_bodyid.tolist()
        self._kinds = [Toucher.PART if body in loose else self._kind(body, robot) for body in self._body]
        self._is_grasp = [
            not both & _ROBOT or (both & ~FINGERS) == Toucher.PART for both in range(2 * Toucher.RIGHT_FINGER)
        ]
        self.forbidden: dict[tuple[str, str], float] = {}  # Time of the first forbidden touch of two bodies [s].

    def look(self, t: float) -> dict[str, PartState]:
        """Return the state of every part at ``t`` [s], as it was after the last physics step."""
        touched, force = dict.fromkeys(self._body, 0), dict.fromkeys(self._body, 0.0)
        kinds, body = self._kinds, self._body
        for contact, (first, second) in enumerate(self._data.contact.geom.tolist()):
            one, other = kinds[first], kinds[second]
            touched[body[first]] |= other
            touched[body[second]] |= one
            # An arm may touch parts with its fingers. It must touch nothing else, not even itself or the other arm.
            if not self._is_grasp[one | other]:
                pair = self._model.body(body[first]).name, self._model.body(body[second]).name
                self.forbidden.setdefault(pair, t)
            pressed = self._pressed.intersection((body[first], body[second]))
            if pressed and one | other == Toucher.PART | Toucher.SURROUNDINGS:
                self._contact_force(contact, self._wrench)
                force[pressed.pop()] += self._wrench.item(0)
        places, rotations = self._data.xpos, self._data.xmat
        return {
            name: PartState(
                tuple(places[part].tolist()), math.acos(min(rotations[part, 8], 1.0)), touched[part], force[part]
            )
            for name, part in self._parts.items()
        }

    def _kind(self, body: int, robot: Robot) -> int:
        """Return the flag of a body that is not a part. It depends on the robot's joint by which the body is moved."""
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


HELD_TIME = 1.0  # The time for which a part has to be held, or to rest [s].
_LIFT = 0.095  # The least height to which a part is lifted [m].
_CARRY = 0.1  # The least distance over which a part is carried [m].
# A part that no finger touches has fallen if it sinks by more than this [m]. After fingers put it down, it sinks less.
_FALL = 0.005
_PUT_BACK = (0.01, 0.001)  # The largest distance from the position at the start, sideways and in height [m].
_STACKED = (0.01, 0.001)  # The largest distance from the position on the part below, sideways and in height [m].
_UPRIGHT = math.radians(2.0)  # The largest tilt of a stacked part [rad].
_LEVEL = math.radians(5.0)  # The limit of the tilt of a part that both hands carry [rad].


class Judge:
    """Follows one task through a run. This base class measures how deep a part fell without a finger on it."""

    def __init__(self, *parts: str) -> None:
        self.parts = parts
        self._held_at: dict[str, float] = {}  # The last height of a part with a finger on it [m].
        self._fell = dict.fromkeys(parts, 0.0)  # The deepest fall of each part [m].

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        """Take the new state of all parts. The last call was ``dt`` [s] earlier."""
        for name in self.parts:
            height = parts[name].place[2]
            if parts[name].touched & FINGERS:
                self._held_at[name] = height
            self._fell[name] = max(self._fell[name], self._held_at.get(name, height) - height)

    def measured(self) -> dict[str, float]:
        """Return the measured figures so far, by name. Each name ends with the unit."""
        return {"fall_mm": 1e3 * max(self._fell.values())}

    def faults(self) -> list[str]:
        """Return why the task is not done yet. The list is empty after success."""
        return [f"{name}: fell {1e3 * depth:.0f} mm" for name, depth in self._fell.items() if depth > _FALL]


class LiftJudge(Judge):
    """A part is lifted, held up for a second and put back to where it lay, without a fall.

    After the part has lain there for a second, the judge ignores it, because another task may use it.
    """

    _wanted = f"held {1e3 * _LIFT:.0f} mm up"

    def __init__(self, part: str) -> None:
        super().__init__(part)
        self._start: tuple[float, float, float] | None = None  # The position at the start [m].
        # _held: the time for which the part has been held up until now [s]. _longest: the longest such time [s].
        # _height: the greatest height of the part above the start [m]. _lain: the time for which the part has lain at
        # the start again [s].
        self._held = self._longest = self._height = self._lain = 0.0
        self._away = (0.0, 0.0)  # The distance from the start, sideways and in height [m].

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        if self._lain >= HELD_TIME:
            return
        super().see(dt, parts)
        part = parts[self.parts[0]]
        self._start = self._start or part.place
        self._away = math.dist(part.place[:2], self._start[:2]), part.place[2] - self._start[2]
        self._held = self._held + dt if self._is_up(part) else 0.0
        self._longest = max(self._longest, self._held)
        self._height = max(self._height, self._away[1])
        back = self._longest >= HELD_TIME and self._is_back and not part.touched & FINGERS
        self._lain = self._lain + dt if back else 0.0

    def _is_up(self, part: PartState) -> bool:
        return bool(part.touched) and not part.touched & ~FINGERS and self._away[1] >= _LIFT

    @property
    def _is_back(self) -> bool:
        return self._away[0] <= _PUT_BACK[0] and abs(self._away[1]) <= _PUT_BACK[1]

    def measured(self) -> dict[str, float]:
        away = 1e3 * math.hypot(*self._away)
        found = {"lifted_mm": 1e3 * self._height, "held_s": self._longest, "put_back_mm": away}
        return found | super().measured()

    def faults(self) -> list[str]:
        faults, part = super().faults(), self.parts[0]
        if self._longest < HELD_TIME:
            faults.append(f"{part}: {self._wanted} for {self._longest:.1f} s, not {HELD_TIME:g} s")
        if not self._is_back:
            faults.append(f"{part}: ended {1e3 * math.hypot(*self._away):.0f} mm from where it lay")
        return faults


class CarryJudge(LiftJudge):
    """The task of :class:`LiftJudge`, but with both hands, 100 mm away, and with a tilt that stays below 5 degrees."""

    _wanted = f"held by both hands, {1e3 * _LIFT:.0f} mm up and {1e3 * _CARRY:.0f} mm away,"

    def __init__(self, part: str) -> None:
        super().__init__(part)
        self._tilt = 0.0

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        super().see(dt, parts)
        self._tilt = max(self._tilt, parts[self.parts[0]].tilt)

    def _is_up(self, part: PartState) -> bool:
        return part.touched == FINGERS and self._away[0] >= _CARRY and self._away[1] >= _LIFT

    def measured(self) -> dict[str, float]:
        return {"tilt_deg": math.degrees(self._tilt)} | super().measured()

    def faults(self) -> list[str]:
        tilted = [f"{self.parts[0]}: inclined by {math.degrees(self._tilt):.1f} deg"] if self._tilt >= _LEVEL else []
        return super().faults() + tilted


class StackJudge(Judge):
    """Parts rest on each other, upright and without a finger on them, for the last second."""

    def __init__(self, parts: Mapping[str, float]) -> None:
        """``parts`` are the parts from the lowest to the highest, with their heights [m]."""
        super().__init__(*parts)
        self._rest = [0.5 * (low + high) for low, high in pairwise(parts.values())]  # Distances of centres [m].
        self._stood = self._sideways = self._tilt = 0.0

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        super().see(dt, parts)
        tower = [parts[name] for name in self.parts]
        self._tilt = max(part.tilt for part in tower)
        self._sideways = max(math.dist(upper.place[:2], lower.place[:2]) for lower, upper in pairwise(tower))
        gaps = [upper.place[2] - lower.place[2] for lower, upper in pairwise(tower)]
        off = max(abs(gap - rest) for gap, rest in zip(gaps, self._rest, strict=True))
        stands = self._sideways <= _STACKED[0] and off <= _STACKED[1] and self._tilt <= _UPRIGHT
        untouched = not any(part.touched & FINGERS for part in tower)
        self._stood = self._stood + dt if stands and untouched else 0.0

    def measured(self) -> dict[str, float]:
        tilt = math.degrees(self._tilt)
        return {"stood_s": self._stood, "off_centre_mm": 1e3 * self._sideways, "tilt_deg": tilt} | super().measured()

    def faults(self) -> list[str]:
        faults = super().faults()
        if self._stood < HELD_TIME:
            tower = " on ".join(reversed(self.parts))
            faults.append(f"{tower} for the last {self._stood:.1f} s, not {HELD_TIME:g} s")
        return faults


class HandoverJudge(Judge):
    """One hand holds a part in the air. Then both hands hold it. Then the other hand holds it alone for a second.

    The other hand has to hold it at least 100 mm from the position at which the first hand let go.
    """

    def __init__(self, part: str, giver: int, taker: int) -> None:
        super().__init__(part)
        self._giver, self._taker = giver, taker
        # _by_giver: the time for which the giver held the part [s]. _by_both: the time for which both hands held it
        # [s]. _alone: the time for which the taker has held it far enough away until now [s]. _longest: the longest
        # such time [s]. _farthest: the greatest distance of the part from the position at which the giver let go [m].
        self._by_giver = self._by_both = self._alone = self._longest = self._farthest = 0.0
        self._given: tuple[float, float, float] | None = None  # The position at which the giver let go [m].

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        super().see(dt, parts)
        part, away = parts[self.parts[0]], 0.0
        if part.touched == self._giver:
            self._by_giver += dt
        elif part.touched == FINGERS and self._by_giver:
            self._by_both += dt
            self._given = part.place
        elif part.touched == self._taker and self._given is not None:
            away = math.dist(part.place, self._given)
            self._farthest = max(self._farthest, away)
        self._alone = self._alone + dt if away >= _CARRY else 0.0
        self._longest = max(self._longest, self._alone)

    def measured(self) -> dict[str, float]:
        held = {"held_by_giver_s": self._by_giver, "held_by_both_s": self._by_both}
        carried = {"carried_mm": 1e3 * self._farthest, "held_by_taker_s": self._longest}
        return held | carried | super().measured()

    def faults(self) -> list[str]:
        faults = super().faults()
        if self._longest < HELD_TIME:
            held = f"held by the taker alone, {1e3 * _CARRY:.0f} mm away, for {self._longest:.1f} s"
            faults.append(f"{self.parts[0]}: {held}, not {HELD_TIME:g} s")
        return faults
