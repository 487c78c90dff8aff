"""Tasks of two hands, as way points of their tools in the world frame.

The motion of each hand is the motion that its tool has to make. The hands may start at any poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array

# Time [s], position x y z [m], tilt about x [rad], and a turn about z that is applied before the tilt [rad].
WayPoint = tuple[float, float, float, float, float, float]

_X, _Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def minimum_jerk(fraction: float) -> float:
    """Return the fraction of the path that is done after a ``fraction`` of the time (Flash and Hogan, 1985).

    A ``fraction`` outside of 0 .. 1 is clipped.
    """
    s = min(max(fraction, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


class WayPoints:
    """A motion through ``points``, whose times have to rise. It rests before the first point and after the last one.

    Each motion from point to point has minimum jerk, and rests at both ends.
    """

    def __init__(self, points: Sequence[WayPoint]) -> None:
        table = np.array(points, dtype=np.float64)
        self._times, self._values = table[:, 0], table[:, 1:]

    def at(self, t: float) -> tuple[Array, Array]:
        """Return the tool's position (3,) [m] in the world frame at ``t`` [s], and its rotation vector (3,) [rad].

        The rotation is relative to the tool's rotation at home.
        """
        times, values = self._times, self._values
        index = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
        share = minimum_jerk((t - times[index]) / (times[index + 1] - times[index]))
        where = (1.0 - share) * values[index] + share * values[index + 1]
        tilt, turn = where[3:]
        if turn == 0.0:
            return where[:3], tilt * _X
        return where[:3], pin.log3(pin.exp3(tilt * _X) @ pin.exp3(turn * _Z))


# Positions of the tools at home [m]. The tools point straight down, and their fingers close along y.
HOME: Mapping[str, tuple[float, float, float]] = {"left": (0.50, 0.25, 0.38), "right": (0.50, -0.25, 0.38)}
LEFT_HOME, RIGHT_HOME = (*HOME["left"], 0.0, 0.0), (*HOME["right"], 0.0, 0.0)


@dataclass(frozen=True)
class HandWork:
    """The motion of both hands, from home and back to home."""

    duration: float  # [s]
    # For each hand, the way points after home, at rising times. A hand without way points rests.
    tools: Mapping[str, tuple[WayPoint, ...]]
    steps: tuple[tuple[float, str], ...]  # Start of each step [s], and the step in words.
    presses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # Upper button's presses, for each hand [s].
    grips: tuple[float, ...] = ()  # Taps of the left grip, which begin or end a carry [s].
    engages: tuple[float, ...] = ()  # Presses of both lower buttons [s].
    # Start and end of each time span in which both sticks are pushed up, for precision [s].
    precise: tuple[tuple[float, float], ...] = ()

    def moved(self, x: float, y: float) -> HandWork:
        """Return the same work for parts that are shifted by ``x`` and ``y`` [m] along the axes of the world."""
        tools = {
            hand: tuple((p[0], p[1] + x, p[2] + y, *p[3:]) if p[1:4] != HOME[hand] else p for p in points)
            for hand, points in self.tools.items()
        }
        return replace(self, tools=tools)
