"""Hand motion through way points, as people reach: at rest at each of them, between them by minimum jerk."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array

# Time [s], place x y z [m], tilt about x [rad], and the turn about z that comes before it [rad].
WayPoint = tuple[float, float, float, float, float, float]

_X, _Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def minimum_jerk(fraction: float) -> float:
    """Share of the way at a ``fraction`` of the time: 0 to 1, at rest at both ends; fractions beyond them are cut.

    Flash and Hogan, The coordination of arm movements, 1985.
    """
    s = min(max(fraction, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def later(point: WayPoint, delay: float) -> WayPoint:
    """The same place, ``delay`` [s] later."""
    t, x, y, z, tilt, turn = point
    return delay + t, x, y, z, tilt, turn


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
