"""Motions that two arms make at work, near each other, near the table and at the end of their reach.

Made for ``config/dual_iiwa7.yaml``. Targets are functions of time and of the tools at the start alone, so that any
controller can be asked for the same. Each motion begins with an approach from home, and ends with the targets held
still for :data:`REST`. Tools keep their rotation, in which they point straight down, unless the motion says otherwise.

How near is near: with both tools pointing down at one height, wrists keep 20 mm from each other down to 0.18 m between
the tools. Pointing down, a tool gets 0.73 m away from its arm's mount (0.38 m above it), so that no arm reaches the
place where the other one's tool has its home.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.types import Array

ARMS = ("left", "right")
REST = 2.0  # with still targets at the end, unless a motion says otherwise [s]
_LEG = 2.0  # of an approach, from place to place [s]
_SETTLE = 0.5  # between the approach and the motion [s]

# Positions of both tools in the world, (2, 3) [m], the left one's first: those of a motion by the time since it began
# [s] and by where the tools are at home.
Path = Callable[[float, Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class WorkMotion:
    """What both tools are asked to do over time."""

    name: str
    about: str
    duration: float  # between approach and rest [s]
    path: Path
    approach: tuple[Array, ...] = ()  # places (2, 3) on the way from home [m]; the last is where the motion begins
    tilt: tuple[float, float] = (0.0, 0.0)  # turn of each tool about the world's x, kept from the approach on [rad]
    has_goal: bool = False  # whether arriving at the last targets is what it is about
    reachable: bool = True  # whether both arms can be at all targets with every distance kept
    rest: float = REST  # with still targets at the end [s]

    @property
    def begins(self) -> float:
        """End of the approach, from which on the motion is measured [s]."""
        return _LEG * len(self.approach) + _SETTLE

    @property
    def rests(self) -> float:
        """From when on the targets are still [s]."""
        return self.begins + self.duration

    @property
    def ends(self) -> float:
        """Time in all [s]."""
        return self.rests + self.rest

    def targets(self, t: float, start: Mapping[str, pin.SE3]) -> dict[str, pin.SE3]:
        """Tool poses that are asked for at ``t`` [s], by those at the start; both in the world frame."""
        home = np.array([start[arm].translation for arm in ARMS])
        turned = 1.0
        if t >= self.begins:
            places = self.path(min(t - self.begins, self.duration), home)
        elif self.approach:
            stops = (home, *self.approach)
            leg = min(int(t / _LEG), len(stops) - 2)
            places = _between(stops[leg], stops[leg + 1], t / _LEG - leg)
            turned = minimum_jerk(t / _LEG)
        else:
            places = home
        return {
            arm: pin.SE3(pin.exp3(np.array([turned * tilt, 0.0, 0.0])) @ start[arm].rotation, place)
            for arm, tilt, place in zip(ARMS, self.tilt, places, strict=True)
        }


def motions_named(names: Iterable[str]) -> tuple[WorkMotion, ...]:
    """The motions of :data:`WORK_MOTIONS` of these names, in its order.

    ``carry`` stands for all motions whose names begin with ``carry-``, and so on. Raises :class:`ConfigError` for a
    name that is neither.
    """
    chosen: set[str] = set()
    for name in names:
        found = {known for known in WORK_MOTIONS if known == name or known.startswith(f"{name}-")}
        if not found:
            raise ConfigError(f"motion {name!r:.60}: allowed: {', '.join(WORK_MOTIONS)}, or what names begin with")
        chosen |= found
    return tuple(motion for name, motion in WORK_MOTIONS.items() if name in chosen)


def _places(left: tuple[float, float, float], right: tuple[float, float, float]) -> Array:
    return np.array([left, right])


def _between(first: Array, last: Array, fraction: float) -> Array:
    return first + minimum_jerk(fraction) * (last - first)


def _way(first: Array, last: Array, duration: float) -> Path:
    """Straight from place to place (2, 3)."""
    return lambda t, home: _between(first, last, t / duration)


def _uniform(t: float, way: float, speed: float, ramp: float) -> float:
    """How far along a ``way`` at a ``speed`` that is reached, and left, within the time ``ramp``."""
    duration = way / speed + ramp
    if t < ramp:
        return 0.5 * speed * t**2 / ramp
    if t > duration - ramp:
        return way - 0.5 * speed * (duration - t) ** 2 / ramp
    return speed * (t - 0.5 * ramp)


_CARRY_CENTRE, _CARRY_RADIUS, _CARRY_RISE = (0.52, 0.36), 0.08, 0.04  # x and z [m], of x, of z [m]
_CARRY_RAMP, _CARRY_SHORTEST = 0.5, 3.0  # [s]


def carry(gap: float, speed: float, shortest: float = _CARRY_SHORTEST) -> WorkMotion:
    """Both tools, ``gap`` [m] apart, go round at ``speed`` [m/s] as if they held one thing.

    In whole laps that take at least the time ``shortest`` [s].
    """
    rate = speed / _CARRY_RADIUS
    turn = 2.0 * math.pi * max(1, math.ceil(shortest * rate / (2.0 * math.pi)))

    def path(t: float, home: Array) -> Array:
        phase = _uniform(t, turn, rate, _CARRY_RAMP)
        x = _CARRY_CENTRE[0] + _CARRY_RADIUS * math.sin(phase)
        z = _CARRY_CENTRE[1] + _CARRY_RISE * (1.0 - math.cos(phase))
        return _places((x, 0.5 * gap, z), (x, -0.5 * gap, z))

    return WorkMotion(
        name=f"carry-{gap:.2f}-{speed:.2f}",
        about=f"both tools on one path, {gap:.2f} m apart, at {speed:.2f} m/s",
        duration=turn / rate + _CARRY_RAMP,
        path=path,
        approach=(path(0.0, np.empty((2, 3))),),
        reachable=gap > _LEAST_GAP,
    )


_LEAST_GAP = 0.18  # between tools at one height, for wrists 20 mm apart [m]
_MEETING_GAP = 0.12  # that is asked for [m]
_MEETING_WAY, _MEETING_STAY = 1.5, 2.0  # [s]


def _meet(t: float, home: Array) -> Array:
    """The tools meet in the middle, 30 mm nearer than each can, stay, and part again."""
    nearest = home.copy()
    nearest[:, 1] = 0.5 * _MEETING_GAP * np.sign(home[:, 1])
    if t < _MEETING_WAY + _MEETING_STAY:
        return _between(home, nearest, t / _MEETING_WAY)
    return _between(nearest, home, (t - _MEETING_WAY - _MEETING_STAY) / _MEETING_WAY)


# Side by side, and past each other: the left tool behind the right one's arm, above its elbow's way.
_APART = _places((0.30, 0.25, 0.40), (0.58, -0.25, 0.26))
_PAST = _places((0.30, -0.05, 0.40), (0.58, 0.05, 0.26))
_PASSING = 2.0  # [s]

_FACING = _places((0.44, 0.25, 0.33), (0.44, -0.25, 0.33))
_CROSSED = _places((0.44, -0.05, 0.33), (0.44, 0.05, 0.33))


def _cross(t: float, home: Array) -> Array:
    """Sideways at one depth, where the tools cannot pass, and only then apart to where they can."""
    if t < _PASSING:
        return _between(_FACING, _CROSSED, t / _PASSING)
    return _between(_CROSSED, _PAST, t / _PASSING - 1.0)


def _swap(t: float, home: Array) -> Array:
    return _between(home, home[::-1], t / _PASSING)


_BEFORE_REACHING = _places((0.50, 0.05, 0.47), (0.50, -0.25, 0.30))
_REACHED_UNDER = _places((0.50, 0.05, 0.47), (0.50, 0.08, 0.30))

_OSCILLATION, _PERIODS = 0.5, 3  # [Hz]
_LEAST_OSCILLATING_GAP = 0.06  # [m]


def _oscillate(t: float, home: Array) -> Array:
    """Sideways, from home until the targets are 0.06 m apart, and back."""
    share = 0.5 * (1.0 - math.cos(2.0 * math.pi * _OSCILLATION * t))
    places = home.copy()
    places[:, 1] -= share * (home[:, 1] - 0.5 * _LEAST_OSCILLATING_GAP * np.sign(home[:, 1]))
    return places


_SLIDING_HEIGHT = 0.2045  # 10 mm lower than the millimetre that fingers keep from the table allows [m]
_SLIDE_FROM = (0.50, 0.40)  # x and y [m]
_SLIDE_WAY, _SLIDE_SPEED, _SLIDE_RAMP = 0.3, 0.2, 0.2  # [m], [m/s], [s]
_RIGHT_ASIDE = (0.50, -0.25, 0.38)


def _slide(t: float, home: Array) -> Array:
    """The left tool sideways over the table; the right one stays aside."""
    y = _SLIDE_FROM[1] - _uniform(t, _SLIDE_WAY, _SLIDE_SPEED, _SLIDE_RAMP)
    return _places((_SLIDE_FROM[0], y, _SLIDING_HEIGHT), _RIGHT_ASIDE)


_FARTHEST_AHEAD = 0.80  # that is asked for; 0.73 can be reached [m]
_STRETCHING, _STRETCHED = 2.0, 0.5  # [s]


def _stretch(t: float, home: Array) -> Array:
    """Straight ahead until the arms are stretched out, 70 mm farther than they reach, and back."""
    ahead = home.copy()
    ahead[:, 0] = _FARTHEST_AHEAD
    if t < _STRETCHING + _STRETCHED:
        return _between(home, ahead, t / _STRETCHING)
    return _between(ahead, home, (t - _STRETCHING - _STRETCHED) / _STRETCHING)


_ALL = (
    *(carry(gap, speed) for gap in (0.40, 0.20, 0.16) for speed in (0.15, 0.30, 0.50)),
    carry(0.16, 0.04),
    WorkMotion(
        name="meet",
        about="the tools meet, asked for 30 mm more than each can, stay 2 s and part",
        duration=2.0 * _MEETING_WAY + _MEETING_STAY,
        path=_meet,
        has_goal=True,
        reachable=False,
    ),
    WorkMotion(
        name="pass",
        about="the arms get past each other, at different depths and heights",
        duration=_PASSING,
        path=_way(_APART, _PAST, _PASSING),
        approach=(_APART,),
        has_goal=True,
    ),
    WorkMotion(
        name="pass-back",
        about="the same, back",
        duration=_PASSING,
        path=_way(_PAST, _APART, _PASSING),
        approach=(_APART, _PAST),
        has_goal=True,
    ),
    WorkMotion(
        name="cross",
        about="the tools change sides; the targets go through each other, a small detour leads there",
        duration=2.0 * _PASSING,
        path=_cross,
        approach=(_FACING,),
        has_goal=True,
        reachable=False,
    ),
    WorkMotion(
        name="swap",
        about="each tool is asked for the other one's home, where neither arm reaches and both are in the way",
        duration=_PASSING,
        path=_swap,
        has_goal=True,
        reachable=False,
    ),
    WorkMotion(
        name="reach-under",
        about="the right tool, tilted by 0.9 rad, reaches under the left one",
        duration=_PASSING,
        path=_way(_BEFORE_REACHING, _REACHED_UNDER, _PASSING),
        approach=(_BEFORE_REACHING,),
        tilt=(0.0, 0.9),
        has_goal=True,
    ),
    WorkMotion(
        name="oscillate",
        about="the targets swing at 0.5 Hz, up to 0.06 m from each other",
        duration=_PERIODS / _OSCILLATION,
        path=_oscillate,
        reachable=False,
    ),
    WorkMotion(
        name="slide",
        about="the left tool slides 0.3 m over the table, asked to be 10 mm lower than it may",
        duration=_SLIDE_WAY / _SLIDE_SPEED + _SLIDE_RAMP,
        path=_slide,
        approach=(_slide(0.0, np.empty((2, 3))),),
        reachable=False,
    ),
    WorkMotion(
        name="stretch",
        about="both tools are asked for 70 mm more than they reach, and back",
        duration=2.0 * _STRETCHING + _STRETCHED,
        path=_stretch,
        has_goal=True,
        reachable=False,
    ),
)
WORK_MOTIONS: dict[str, WorkMotion] = {motion.name: motion for motion in _ALL}
