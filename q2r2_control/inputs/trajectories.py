"""Ideal hand motions with their button presses, to test the robot's response without an operator.

All are displacements from wherever the hands start. Those that are not assembly work are written for the left hand, and
the right hand mirrors them left to right. Axes: x forwards, y to the left, z up. Only those that pick something up go
below the start, to what lies on the table of config/dual_iiwa7.yaml.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.assembly import HOME, WORKS, HandWork, WayPoint, WayPoints, later, minimum_jerk
from q2r2_control.types import SIDES, Array, HandInputs

PRESS_DURATION = 0.15  # [s]
FIRST_PRESS = 0.6  # when the lower buttons engage both arms [s]
START = 1.2  # of the motion [s]
_LAST_PRESS, _REST = 0.4, 0.6  # after work: the lower buttons pause both arms, and then the end [s]
_RAMP = 1.0  # periodic motions gather speed for this long [s]


# (t [s], frequency [Hz]) -> displacement (3,) [m] and rotation vector (3,) [rad] of a hand.
Path = Callable[[float, float], tuple[Array, Array]]


@dataclass(frozen=True)
class HandTrajectory:
    """What both hands do over time."""

    left: Path
    right: Path | None = None  # None: the left hand's, mirrored
    upper_presses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # hand -> times [s]
    lower_presses: tuple[float, ...] = (FIRST_PRESS,)  # of both hands [s]
    duration: float | None = None  # None: without end [s]

    def displacement(self, hand: str, t: float, frequency: float) -> tuple[Array, Array]:
        """Displacement (3,) [m] and rotation vector (3,) [rad] of ``hand`` at ``t`` [s]."""
        if hand == "left":
            return self.left(t, frequency)
        if self.right is not None:
            return self.right(t, frequency)
        displacement, turn = self.left(t, frequency)
        return displacement * (1.0, -1.0, 1.0), turn * (-1.0, 1.0, -1.0)

    def inputs(self, hand: str, t: float) -> HandInputs:
        """Buttons of ``hand`` at time ``t`` [s]; a closed hand also shows on the index trigger."""
        upper = self.upper_presses.get(hand, ())
        return HandInputs(
            button_upper=_pressed(upper, t),
            button_lower=_pressed(self.lower_presses, t),
            press_index=float(sum(press <= t for press in upper) % 2),
        )


def _pressed(presses: tuple[float, ...], t: float) -> bool:
    return any(press <= t < press + PRESS_DURATION for press in presses)


def _phase(t: float, frequency: float) -> float:
    """Angle of a periodic motion that gathers speed without a jerk [rad]."""
    elapsed = max(t - START, 0.0)
    if elapsed < _RAMP:
        return math.pi * frequency * (elapsed - _RAMP / math.pi * math.sin(math.pi * elapsed / _RAMP))
    return 2.0 * math.pi * frequency * (elapsed - _RAMP / 2.0)


def _circle(t: float, frequency: float) -> tuple[Array, Array]:
    """Radius 0.1 m, sidewards and up, as Quest2ROS2's SimulationInput draws it."""
    phase = _phase(t, frequency)
    return np.array([0.0, 0.1 * math.sin(phase), 0.1 * (1.0 - math.cos(phase))]), np.zeros(3)


def _line(t: float, frequency: float) -> tuple[Array, Array]:
    """0.15 m there and back, forwards and up."""
    way = 0.15 * (1.0 - math.cos(_phase(t, frequency))) / 2.0
    return way * np.array([0.6, 0.0, 0.8]), np.zeros(3)


def _rotate(t: float, frequency: float) -> tuple[Array, Array]:
    """30 degrees there and back about x, y and z in turn, 0.05 m above the start."""
    phase = _phase(t, frequency)
    turn = np.zeros(3)
    turn[int(phase / (2.0 * math.pi)) % 3] = math.radians(30.0) * (1.0 - math.cos(phase)) / 2.0
    lift = 0.05 * minimum_jerk((t - START) / _RAMP)
    return np.array([0.0, 0.0, lift]), turn


def in_sequence(works: Sequence[HandWork]) -> HandTrajectory:
    """Hands that do one work after the other, and then pause."""
    homes: dict[str, WayPoint] = {hand: (0.0, *HOME[hand], 0.0, 0.0) for hand in SIDES}
    points = {hand: [home] for hand, home in homes.items()}
    presses: dict[str, list[float]] = {hand: [] for hand in SIDES}
    begins = START
    for work in works:
        for hand, home in homes.items():
            way = [later(point, begins) for point in (home, *work.tools.get(hand, ()))]
            points[hand] += [point for point in way if point[0] > points[hand][-1][0]]
            presses[hand] += [begins + t for t in work.presses.get(hand, ())]
        begins += work.duration
    return HandTrajectory(
        left=_from_home(points["left"], "left"),
        right=_from_home(points["right"], "right"),
        upper_presses={hand: tuple(times) for hand, times in presses.items()},
        lower_presses=(FIRST_PRESS, begins + _LAST_PRESS),
        duration=begins + _LAST_PRESS + _REST,
    )


def _from_home(points: Sequence[WayPoint], hand: str) -> Path:
    way, home = WayPoints(points), np.array(HOME[hand])

    def displacement(t: float, frequency: float) -> tuple[Array, Array]:
        place, turn = way.at(t)
        return place - home, turn

    return displacement


TRAJECTORIES: Mapping[str, HandTrajectory] = {
    "circle": HandTrajectory(_circle),
    "line": HandTrajectory(_line),
    "rotate": HandTrajectory(_rotate),
    **{name: in_sequence([work]) for name, work in WORKS.items()},
}


def trajectory_named(name: str) -> HandTrajectory:
    """One of :data:`TRAJECTORIES`, or several works one after the other, such as ``handover+stack``.

    Raises :class:`ConfigError` for any other name.
    """
    if name in TRAJECTORIES:
        return TRAJECTORIES[name]
    works = name.split("+")
    if not all(work in WORKS for work in works):
        allowed = f"{', '.join(TRAJECTORIES)}, and {', '.join(WORKS)} joined by +"
        raise ConfigError(f"scripted trajectory {name!r:.60}: allowed are {allowed}")
    return in_sequence([WORKS[work] for work in works])
