"""How near a run's reference came to the joints' limits, reduced in batches so that a tick only stores three rows."""

from __future__ import annotations

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Reference

# Reducing a batch takes as long as a dozen of its ticks' rows: no longer than a tick has to spare.
_BATCH = 256


class JointExtremes:
    """Gathers the extremes of all joints and ticks. Numbers that are not finite are passed over."""

    def __init__(self, robot: Robot, control: ControllerSettings) -> None:
        self._lower, self._upper = robot.position_lower, robot.position_upper
        self._velocity_limit: Array = control.velocity_scale * robot.velocity_limit
        self._acceleration_limit: Array = robot.capped_acceleration(control.acceleration_limit)
        self._position_margin = control.position_margin
        self._q, self._v, self._a = (np.zeros((_BATCH, robot.model.nv)) for _ in range(3))
        self._used = 0
        self._velocity, self._acceleration, self._margin = 0.0, 0.0, float("inf")

    def add(self, reference: Reference) -> None:
        """Take one tick's reference."""
        row = self._used
        self._q[row], self._v[row], self._a[row] = reference.q, reference.v, reference.a
        self._used = row + 1
        if self._used == _BATCH:
            self._reduce()

    @property
    def velocity_ratio(self) -> float:
        """The largest velocity, to its limit; 0 before the first tick."""
        self._reduce()
        return self._velocity

    @property
    def acceleration_ratio(self) -> float:
        """The largest acceleration, to its limit; 0 before the first tick."""
        self._reduce()
        return self._acceleration

    @property
    def position_margin(self) -> float:
        """The least room to a position limit, beyond the configured margin [rad]; infinite before the first tick."""
        self._reduce()
        return self._margin

    def _reduce(self) -> None:
        if not self._used:
            return
        q, v, a = self._q[: self._used], self._v[: self._used], self._a[: self._used]
        self._used = 0
        self._velocity = max(self._velocity, _largest(np.abs(v) / self._velocity_limit))
        self._acceleration = max(self._acceleration, _largest(np.abs(a) / self._acceleration_limit))
        room = -_largest(-np.minimum(q - self._lower, self._upper - q))
        self._margin = min(self._margin, room - self._position_margin)


def _largest(values: Array) -> float:
    return float(np.fmax.reduce(values, axis=None))
