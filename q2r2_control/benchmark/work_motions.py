"""Work motions of two arms: near each other, near the table, and as far away as the arms can reach.

The motions are made for ``config/dual_iiwa7.yaml``. Targets depend only on time and on the tool poses at the start, so
every controller can get the same targets. Each motion begins with an approach from home, and ends with constant targets
for :data:`REST`. Tools point straight down and keep this rotation, unless the motion says otherwise.

If both tools point down at equal heights, 0.18 m apart, the wrists are 20 mm apart. A tool that points down can reach
0.73 m from its arm's mount, at a height of 0.38 m above the mount. An arm whose tool points down cannot reach the home
position of the other arm's tool.
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
REST = 2.0  # Duration of the constant targets at the end, if a motion does not set its own ``rest`` [s].
_LEG = 2.0  # Time in which an approach moves from one position to the next [s].
_SETTLE = 0.5  # Time between the approach and the motion [s].

# A function that returns the target positions of both tools in the world frame (2, 3) [m], with the left tool first.
# Its arguments are the time since the motion began [s], and the tools' positions at home (2, 3) [m].
Path = Callable[[float, Array], Array]
# The positions at which a motion stops (2, 3) [m], or a function that computes them from the tools' positions at home.
Stop = Array | Callable[[Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class WorkMotion:
    """The targets of both tools over time."""

    name: str
    about: str
    duration: float  # Time between the approach and the rest at the end [s].
    path: Path
    # Positions (2, 3) through which the tools move from home [m]. The motion starts at the last of them.
    approach: tuple[Array, ...] = ()
    # The angle by which each tool turns about the world's x axis during the approach [rad]. The tool keeps this angle.
    tilt: tuple[float, float] = (0.0, 0.0)
    has_goal: bool = False  # Whether both tools have to arrive at the last targets.
    reachable: bool = True  # Whether both arms can reach all targets with every distance kept.
    rest: float = REST  # Duration of the constant targets at the end [s].

    @property
    def begins(self) -> float:
        """The time at which the approach ends and the measured motion begins [s]."""
        return _LEG * len(self.approach) + _SETTLE

    @property
    def rests(self) -> float:
        """The time after which the targets are constant [s]."""
        return self.begins + self.duration

    @property
    def ends(self) -> float:
        """The total duration [s]."""
        return self.rests + self.rest

    def targets(self, t: float, start: Mapping[str, pin.SE3]) -> dict[str, pin.SE3]:
        """Return the tools' target poses in the world, at ``t`` [s] since the start of the approach, by arm.

        ``start`` has the tool poses at home in the world, by arm.
        """
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
    """Return the motions of :data:`WORK_MOTIONS` with these ``names``, in the order of :data:`WORK_MOTIONS`.

    A name also stands for all motions whose names begin with it and a hyphen: ``carry`` means all ``carry-...``.

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
    """Return a motion with a goal, in which both tools move straight from stop to stop.

    Each item of ``stops`` has the time of travel to a stop [s], and the stop.
    """

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


def _uniform(t: float, length: float, speed: float, ramp: float) -> float:
    """Return the distance [m] that a point has covered at ``t`` [s] on a path. It is an angle [rad] on a circular path.

    The path has this ``length`` [m or rad], and the point has this ``speed`` [m/s or rad/s]. Speeding up and stopping
    take the time ``ramp`` [s] each.
    """
    duration = length / speed + ramp
    if t < ramp:
        return 0.5 * speed * t**2 / ramp
    if t > duration - ramp:
        return length - 0.5 * speed * (duration - t) ** 2 / ramp
    return speed * (t - 0.5 * ramp)


# For the laps: x of the centre and lowest z [m], amplitude in x [m], and amplitude in z [m].
_CARRY_CENTRE, _CARRY_RADIUS, _CARRY_RISE = (0.52, 0.36), 0.08, 0.04
_CARRY_RAMP = 0.5  # Time to reach the speed, and time to stop [s].
_LEAST_GAP = 0.18  # If tools are at equal heights and this far apart, the wrists are 20 mm apart [m].


def carry(gap: float, speed: float, shortest: float = 3.0) -> WorkMotion:
    """Return a motion in which both tools run laps at ``speed`` [m/s], and stay ``gap`` [m] apart.

    The number of laps is whole. It is the smallest number of laps that take at least ``shortest`` [s].
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
    """Return the ``home`` positions of both tools (2, 3) [m], moved sideways until they are ``gap`` [m] apart."""
    return np.column_stack((home[:, 0], 0.5 * gap * np.sign(home[:, 1]), home[:, 2]))


def _home(home: Array) -> Array:
    return home


def _swapped(home: Array) -> Array:
    return home[::-1]


def _ahead(home: Array) -> Array:
    """Return positions (2, 3) that are 0.80 m straight ahead. The tools can reach only 0.73 m."""
    return np.column_stack((np.full(2, 0.80), home[:, 1:]))


def _met(home: Array) -> Array:
    """Return positions (2, 3) near the middle. Each tool would have to get 30 mm nearer to the middle than it can."""
    return _between_tools(home, 0.12)


# The tools are side by side at the first positions, and have passed each other at the second positions. The left tool
# is then behind the right arm, above the path of the right elbow.
_APART = np.array([(0.30, 0.25, 0.40), (0.58, -0.25, 0.26)])
_PAST = np.array([(0.30, -0.05, 0.40), (0.58, 0.05, 0.26)])
# Both tools have the same x, so that they cannot pass each other.
_FACING = np.array([(0.44, 0.25, 0.33), (0.44, -0.25, 0.33)])
_CROSSED = np.array([(0.44, -0.05, 0.33), (0.44, 0.05, 0.33)])
_BEFORE_REACHING = np.array([(0.50, 0.05, 0.47), (0.50, -0.25, 0.30)])
_REACHED_UNDER = np.array([(0.50, 0.05, 0.47), (0.50, 0.08, 0.30)])
_PASSING = 2.0  # Time of travel to a stop [s].
_THROUGH = ((_PASSING, _CROSSED), (_PASSING, _PAST))


def _oscillate(t: float, home: Array) -> Array:
    """Return targets that swing sideways at 0.5 Hz, between home and positions that are 0.06 m from each other."""
    share = 0.5 * (1.0 - math.cos(math.pi * t))
    return home + share * (_between_tools(home, 0.06) - home)


# The height of the sliding target [m]. It is 10 mm lower than the tool may get, since fingers keep 1 mm from the table.
_SLIDING_HEIGHT = 0.2045
_SLIDE_FROM = (0.50, 0.40)  # x and y at which the slide begins [m].
# Length of the path [m], speed [m/s], and time to speed up, which is also the time to stop [s].
_SLIDE_LENGTH, _SLIDE_SPEED, _SLIDE_RAMP = 0.3, 0.2, 0.2
_RIGHT_ASIDE = (0.50, -0.25, 0.38)


def _slide(t: float, home: Array) -> Array:
    """Return a left target that slides sideways over the table, and a right target at rest beside its path (2, 3)."""
    y = _SLIDE_FROM[1] - _uniform(t, _SLIDE_LENGTH, _SLIDE_SPEED, _SLIDE_RAMP)
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
        duration=_SLIDE_LENGTH / _SLIDE_SPEED + _SLIDE_RAMP,
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


# The motions in which the computing time of ticks is measured.
TIMED_MOTIONS = (
    WorkMotion("free motion", "circles of 0.1 m radius at 0.5 Hz in free space", 3.0, _circle, rest=0.0),
    WorkMotion(
        "contact", "targets jump to the other tool's start", 3.0, lambda t, home: home[::-1], reachable=False, rest=0.0
    ),
)
