"""Work motions of two arms near each other, near the table and at the end of their reach.

The motions are made for ``config/dual_iiwa7.yaml``. Targets depend only on time and on the tool poses at the start, so
every controller can get the same targets. Each motion begins with an approach from home, and ends with still targets
for :data:`REST`. Tools keep their rotation, in which they point straight down, unless the motion says otherwise.

With both tools pointing down at one height, the wrists are 20 mm apart when the tools are 0.18 m apart. A tool that
points down can get 0.73 m away from its arm's mount (0.38 m above it). In this rotation, no arm reaches the home of the
other arm's tool.
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
REST = 2.0  # Time with still targets at the end, unless a motion has its own [s].
_LEG = 2.0  # Time of an approach from one position to the next [s].
_SETTLE = 0.5  # Time between the approach and the motion [s].

# A function of the time since the motion began [s] and of the tools' positions at home. It returns the positions of
# both tools in the world frame, (2, 3) [m], with the left one first.
Path = Callable[[float, Array], Array]
Stop = Array | Callable[[Array], Array]  # Positions (2, 3) [m], or a function of the tools' positions at home.


@dataclass(frozen=True, slots=True, eq=False)
class WorkMotion:
    """The targets of both tools over time."""

    name: str
    about: str
    duration: float  # Time between approach and rest [s].
    path: Path
    approach: tuple[Array, ...] = ()  # Positions (2, 3) on the way from home to the start of the motion [m].
    tilt: tuple[float, float] = (0.0, 0.0)  # Turn of each tool about the world's x, kept after the approach [rad].
    has_goal: bool = False  # Whether the purpose is to arrive at the last targets.
    reachable: bool = True  # Whether both arms can reach all targets with every distance kept.
    rest: float = REST  # Time with still targets at the end [s].

    @property
    def begins(self) -> float:
        """The time at which the approach ends and the measured motion begins [s]."""
        return _LEG * len(self.approach) + _SETTLE

    @property
    def rests(self) -> float:
        """The time after which the targets are still [s]."""
        return self.begins + self.duration

    @property
    def ends(self) -> float:
        """The total time [s]."""
        return self.rests + self.rest

    def targets(self, t: float, start: Mapping[str, pin.SE3]) -> dict[str, pin.SE3]:
        """Return the target poses of the tools at ``t`` [s]; ``start`` has their first poses. Both are in the world."""
        home = np.array([start[arm].translation for arm in ARMS])
        turned = 1.0
        if t >= self.begins:
            places = self.path(min(t - self.begins, self.duration), home)
        elif self.approach:
            stops = (home, *self.approach)
            leg = min(int(t / _LEG), len(stops) - 2)
            places = stops[leg] + minimum_jerk(t / _LEG - leg) * (stops[leg + 1] - stops[leg])
            turned = minimum_jerk(t / _LEG)
        else:
            places = home
        return {
            arm: pin.SE3(pin.exp3(np.array([turned * tilt, 0.0, 0.0])) @ start[arm].rotation, place)
            for arm, tilt, place in zip(ARMS, self.tilt, places, strict=True)
        }


def motions_named(names: Iterable[str]) -> tuple[WorkMotion, ...]:
    """Return the motions of :data:`WORK_MOTIONS` with these names, in its order; ``carry`` means all ``carry-...``.

    Raises :class:`ConfigError` for an unknown name.
    """
    chosen: set[str] = set()
    for name in names:
        found = {known for known in WORK_MOTIONS if known == name or known.startswith(f"{name}-")}
        if not found:
            raise ConfigError(f"motion {name!r:.60}: allowed: {', '.join(WORK_MOTIONS)}, or what names begin with")
        chosen |= found
    return tuple(motion for name, motion in WORK_MOTIONS.items() if name in chosen)


def _to(
    name: str,
    about: str,
    *stops: tuple[float, Stop],
    approach: tuple[Array, ...] = (),
    tilt: tuple[float, float] = (0.0, 0.0),
    reachable: bool = False,
) -> WorkMotion:
    """Return a motion with a goal, straight from stop to stop. Each stop has the time of travel to it [s]."""

    def path(t: float, home: Array) -> Array:
        here = approach[-1] if approach else home
        for seconds, stop in stops:
            there = stop(home) if callable(stop) else stop
            if t < seconds:
                return here + minimum_jerk(t / seconds) * (there - here)
            t, here = t - seconds, there
        return here

    duration = sum(seconds for seconds, _ in stops)
    return WorkMotion(name, about, duration, path, approach, tilt, has_goal=True, reachable=reachable)


def _uniform(t: float, way: float, speed: float, ramp: float) -> float:
    """Return the distance that was covered at ``t`` [s], on a path of the length ``way``, at the speed ``speed``.

    Speeding up and stopping take the time ``ramp`` [s] each.
    """
    duration = way / speed + ramp
    if t < ramp:
        return 0.5 * speed * t**2 / ramp
    if t > duration - ramp:
        return way - 0.5 * speed * (duration - t) ** 2 / ramp
    return speed * (t - 0.5 * ramp)


_CARRY_CENTRE, _CARRY_RADIUS, _CARRY_RISE = (0.52, 0.36), 0.08, 0.04  # Centre x and z, radius in x, rise in z [m].
_CARRY_RAMP = 0.5  # Time to reach the speed, and to stop [s].
_LEAST_GAP = 0.18  # Distance between tools at one height at which wrists are 20 mm apart [m].


def carry(gap: float, speed: float, shortest: float = 3.0) -> WorkMotion:
    """Return a motion of both tools in laps at ``speed`` [m/s], ``gap`` [m] apart.

    The number of laps is the least whole number that takes ``shortest`` [s] or more.
    """
    rate = speed / _CARRY_RADIUS
    turn = 2.0 * math.pi * max(1, math.ceil(shortest * rate / (2.0 * math.pi)))

    def path(t: float, home: Array) -> Array:
        phase = _uniform(t, turn, rate, _CARRY_RAMP)
        x = _CARRY_CENTRE[0] + _CARRY_RADIUS * math.sin(phase)
        z = _CARRY_CENTRE[1] + _CARRY_RISE * (1.0 - math.cos(phase))
        return np.array([(x, 0.5 * gap, z), (x, -0.5 * gap, z)])

    return WorkMotion(
        name=f"carry-{gap:.2f}-{speed:.2f}",
        about=f"both tools on one path, {gap:.2f} m apart, at {speed:.2f} m/s",
        duration=turn / rate + _CARRY_RAMP,
        path=path,
        approach=(path(0.0, np.empty((2, 3))),),
        reachable=gap > _LEAST_GAP,
    )


def _between_tools(home: Array, gap: float) -> Array:
    """Return the positions of both tools moved sideways to the middle, ``gap`` [m] apart."""
    return np.column_stack((home[:, 0], 0.5 * gap * np.sign(home[:, 1]), home[:, 2]))


def _home(home: Array) -> Array:
    return home


def _swapped(home: Array) -> Array:
    return home[::-1]


def _ahead(home: Array) -> Array:
    """Return positions 0.80 m straight ahead, of which 0.73 m can be reached."""
    return np.column_stack((np.full(2, 0.80), home[:, 1:]))


def _met(home: Array) -> Array:
    """Return positions in the middle, 30 mm nearer than each tool can get."""
    return _between_tools(home, 0.12)


# Side by side, and past each other. The left tool is then behind the right arm, above the path of the right elbow.
_APART = np.array([(0.30, 0.25, 0.40), (0.58, -0.25, 0.26)])
_PAST = np.array([(0.30, -0.05, 0.40), (0.58, 0.05, 0.26)])
# At the same x, so that the tools cannot pass each other.
_FACING = np.array([(0.44, 0.25, 0.33), (0.44, -0.25, 0.33)])
_CROSSED = np.array([(0.44, -0.05, 0.33), (0.44, 0.05, 0.33)])
_BEFORE_REACHING = np.array([(0.50, 0.05, 0.47), (0.50, -0.25, 0.30)])
_REACHED_UNDER = np.array([(0.50, 0.05, 0.47), (0.50, 0.08, 0.30)])
_PASSING = 2.0  # Time of travel to a stop [s].
_THROUGH = ((_PASSING, _CROSSED), (_PASSING, _PAST))


def _oscillate(t: float, home: Array) -> Array:
    """Return targets that swing sideways at 0.5 Hz between home and positions 0.06 m apart."""
    share = 0.5 * (1.0 - math.cos(math.pi * t))
    return home + share * (_between_tools(home, 0.06) - home)


_SLIDING_HEIGHT = 0.2045  # 10 mm lower than allowed: fingers keep 1 mm from the table [m].
_SLIDE_FROM = (0.50, 0.40)  # Start x and y [m].
_SLIDE_WAY, _SLIDE_SPEED, _SLIDE_RAMP = 0.3, 0.2, 0.2  # Distance [m], speed [m/s], time to speed up and to stop [s].
_RIGHT_ASIDE = (0.50, -0.25, 0.38)


def _slide(t: float, home: Array) -> Array:
    """Return a left target that slides sideways over the table, and a right target that stays aside."""
    y = _SLIDE_FROM[1] - _uniform(t, _SLIDE_WAY, _SLIDE_SPEED, _SLIDE_RAMP)
    return np.array([(_SLIDE_FROM[0], y, _SLIDING_HEIGHT), _RIGHT_ASIDE])


_ALL = (
    *(carry(gap, speed) for gap in (0.40, 0.20, 0.16) for speed in (0.15, 0.30, 0.50)),
    carry(0.16, 0.04),
    _to("meet", "the tools meet 30 mm nearer than they can, stay 2 s and part", (1.5, _met), (2.0, _met), (1.5, _home)),
    _to("pass", "the arms get past each other in depth", (_PASSING, _PAST), approach=(_APART,), reachable=True),
    _to("pass-back", "the same, back", (_PASSING, _APART), approach=(_APART, _PAST), reachable=True),
    _to("cross", "the tools change sides through each other", *_THROUGH, approach=(_FACING,)),
    _to("swap", "each tool is asked for the other one's home, where neither arm reaches", (_PASSING, _swapped)),
    _to(
        "reach-under",
        "the right tool, tilted by 0.9 rad, reaches under the left one",
        (_PASSING, _REACHED_UNDER),
        approach=(_BEFORE_REACHING,),
        tilt=(0.0, 0.9),
        reachable=True,
    ),
    WorkMotion("oscillate", "the targets swing up to 0.06 m from each other", 6.0, _oscillate, reachable=False),
    WorkMotion(
        name="slide",
        about="the left tool slides 0.3 m over the table, asked to be 10 mm lower than it may",
        duration=_SLIDE_WAY / _SLIDE_SPEED + _SLIDE_RAMP,
        path=_slide,
        approach=(_slide(0.0, np.empty((2, 3))),),
        reachable=False,
    ),
    _to("stretch", "both tools are asked for 70 mm more than they reach", (2.0, _ahead), (0.5, _ahead), (2.0, _home)),
)
WORK_MOTIONS: dict[str, WorkMotion] = {motion.name: motion for motion in _ALL}


def _circle(t: float, home: Array) -> Array:
    phase = math.pi * t
    return home + np.array([0.0, 0.1 * math.sin(phase), 0.1 * (1.0 - math.cos(phase))])


# The motions in which ticks are timed.
TIMED_MOTIONS = (
    WorkMotion("free motion", "circles of 0.1 m radius at 0.5 Hz in free space", 3.0, _circle, rest=0.0),
    WorkMotion(
        "contact", "targets jump to the other tool's start", 3.0, lambda t, home: home[::-1], reachable=False, rest=0.0
    ),
)
