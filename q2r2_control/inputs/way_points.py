"""Work of two hands as way points of the tools that follow, in the world; the hands move alike, from anywhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array

# Time [s], place x y z [m], tilt about x [rad], and the turn about z that comes before it [rad].
WayPoint = tuple[float, float, float, float, float, float]

_X, _Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def minimum_jerk(fraction: float) -> float:
    """Share of the way at a ``fraction`` of the time, which is cut to 0 .. 1 (Flash and Hogan, 1985)."""
    s = min(max(fraction, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


class WayPoints:
    """A motion through ``points``, the times of which have to rise; before the first and after the last it rests."""

    def __init__(self, points: Sequence[WayPoint]) -> None:
        table = np.array(points, dtype=np.float64)
        self._times, self._values = table[:, 0], table[:, 1:]

    def at(self, t: float) -> tuple[Array, Array]:
        """Place (3,) [m] and rotation vector (3,) [rad] at ``t`` [s]."""
        times, values = self._times, self._values
        index = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
        share = minimum_jerk((t - times[index]) / (times[index + 1] - times[index]))
        where = (1.0 - share) * values[index] + share * values[index + 1]
        tilt, turn = where[3:]
        if turn == 0.0:
            return where[:3], tilt * _X
        return where[:3], pin.log3(pin.exp3(tilt * _X) @ pin.exp3(turn * _Z))


# Where the tools are at home [m]: pointing straight down, fingers closing along y.
HOME: Mapping[str, tuple[float, float, float]] = {"left": (0.50, 0.25, 0.38), "right": (0.50, -0.25, 0.38)}
LEFT_HOME, RIGHT_HOME = (*HOME["left"], 0.0, 0.0), (*HOME["right"], 0.0, 0.0)


@dataclass(frozen=True)
class HandWork:
    """The motion of both hands, from and to home."""

    duration: float  # [s]
    tools: Mapping[str, tuple[WayPoint, ...]]  # after home, at rising times since the start; a hand without any rests
    steps: tuple[tuple[float, str], ...]  # from when on [s], in words
    presses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # of the upper buttons, by hand [s]
    grips: tuple[float, ...] = ()  # taps of the left grip, which begin to carry and end it [s]
    engages: tuple[float, ...] = ()  # presses of both lower buttons [s]
    precise: tuple[tuple[float, float], ...] = ()  # from when to when both sticks are pushed up, for precision [s]

    def moved(self, x: float, y: float) -> HandWork:
        """The same work on parts that lie ``x`` and ``y`` [m] farther along the axes of the world."""
        tools = {
            hand: tuple((p[0], p[1] + x, p[2] + y, *p[3:]) if p[1:4] != HOME[hand] else p for p in points)
            for hand, points in self.tools.items()
        }
        return replace(self, tools=tools)
