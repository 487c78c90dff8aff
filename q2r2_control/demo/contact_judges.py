"""Judges of tasks that depend on a force or on a tight fit."""

from __future__ import annotations

import math
from collections.abc import Mapping

from q2r2_control.demo.part_judges import FINGERS, HELD_TIME, Judge, PartState, Toucher

_FORCE = (5.0, 15.0)  # The least and the largest force with which the part has to press on the table [N].
_MEAN_TIME = 0.05  # The time constant of the mean force [s].
# Least length of the path on which the part presses with a force within _FORCE [m]. Largest length of the path on which
# it presses with another force, as a share of the length with a force within _FORCE.
_WIPED, _ASTRAY = 0.3, 0.1
_DEEP, _BESIDE = 0.003, 0.001  # The peg's largest distance from the bottom of the hole, and from the hole's middle [m].
_STRAIGHT = math.radians(3.0)  # The largest tilt of the peg and of the part with the hole [rad].


class WipeJudge(Judge):
    """A part that fingers hold is moved over the table, on which it presses with 5 to 15 N."""

    def __init__(self, part: str) -> None:
        super().__init__(part)
        # The part's last position [m]; None if fingers did not hold the part, or if it was not on the table.
        self._place: tuple[float, float] | None = None
        # _force: the mean force [N]. _most: the largest mean force so far [N]. _wiped: the length of the path with a
        # force within _FORCE [m]. _astray: the length of the path with another force [m].
        self._force = self._most = self._wiped = self._astray = 0.0

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        super().see(dt, parts)
        part = parts[self.parts[0]]
        self._force += (part.pressed - self._force) * min(dt / _MEAN_TIME, 1.0)
        self._most = max(self._most, self._force)
        if not (part.touched & FINGERS and part.touched & Toucher.SURROUNDINGS):
            self._place = None
            return
        way = math.dist(part.place[:2], self._place or part.place[:2])
        self._place = part.place[:2]
        if _FORCE[0] <= self._force <= _FORCE[1]:
            self._wiped += way
        else:
            self._astray += way

    def measured(self) -> dict[str, float]:
        wiped = {"wiped_mm": 1e3 * self._wiped, "wiped_with_another_force_mm": 1e3 * self._astray}
        return wiped | {"pressed_N": self._most} | super().measured()

    def faults(self) -> list[str]:
        faults, part = super().faults(), self.parts[0]
        if self._wiped < _WIPED:
            faults.append(f"{part}: wiped {1e3 * self._wiped:.0f} mm with 5 to 15 N, not {1e3 * _WIPED:.0f} mm")
        if self._astray > _ASTRAY * self._wiped:
            faults.append(f"{part}: wiped {1e3 * self._astray:.0f} mm with less than 5 or more than 15 N")
        if self._most > _FORCE[1]:
            faults.append(f"{part}: pressed on with {self._most:.1f} N")
        return faults


class PegJudge(Judge):
    """A part stands straight at the bottom of the hole of another part, without a finger on it, for the last second."""

    def __init__(self, parts: Mapping[str, float]) -> None:
        """``parts`` has two heights [m] by name of the part: of the peg, and then of the bottom of the hole."""
        super().__init__(*parts)
        self._rest = 0.5 * sum(parts.values())  # Vertical distance of the centres when the peg is at the bottom [m].
        # _stood: the time for which the peg has stood in the hole [s]. _beside: the distance of the peg from the hole's
        # middle [m]. _above: the height of the peg above its lowest position [m]. _tilt: the larger tilt of both parts
        # [rad].
        self._stood = self._beside = self._above = self._tilt = 0.0

    def see(self, dt: float, parts: Mapping[str, PartState]) -> None:
        super().see(dt, parts)
        peg, socket = (parts[name] for name in self.parts)
        self._beside = math.dist(peg.place[:2], socket.place[:2])
        self._above = peg.place[2] - socket.place[2] - self._rest
        self._tilt = max(peg.tilt, socket.tilt)
        stands = self._beside <= _BESIDE and abs(self._above) <= _DEEP and self._tilt <= _STRAIGHT
        self._stood = self._stood + dt if stands and not peg.touched & FINGERS else 0.0

    def measured(self) -> dict[str, float]:
        found = {"stood_s": self._stood, "off_centre_mm": 1e3 * self._beside, "off_bottom_mm": 1e3 * self._above}
        return found | {"tilt_deg": math.degrees(self._tilt)} | super().measured()

    def faults(self) -> list[str]:
        faults = super().faults()
        if self._stood < HELD_TIME:
            where = f"{1e3 * self._above:.0f} mm above the bottom, {1e3 * self._beside:.1f} mm off centre"
            faults.append(f"{self.parts[0]}: stood in the hole for {self._stood:.1f} s, not {HELD_TIME:g} s; {where}")
        return faults
