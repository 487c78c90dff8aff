"""Count the turns of continuous joints, whose angle may be reported within one turn, as in (-pi, pi].

If the angle jumps by a whole turn between two reports, the joint has not jumped, as long as it cannot have turned by
half a turn meanwhile. Reports that count turns themselves do not change. The same holds for the first report, and for a
report after a longer gap.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState

_TURN = 2.0 * math.pi


class TurnCounter:
    """Counts the turns of a robot's continuous joints from one measured state to the next."""

    def __init__(self, robot: Robot) -> None:
        joints = self._joints = np.flatnonzero(robot.endless)
        self._half_turn_s = float((math.pi / robot.velocity_limit[joints]).min(initial=math.inf))
        self._last: Array | None = None  # The last positions of these joints with their turns [rad].
        self._at = -math.inf

    def counted(self, q: Array, now: float) -> Array:
        """Return the reported positions ``q`` (nv,) [rad] with the turns of continuous joints; ``now`` is the time [s].

        Without a change ``q`` itself is returned. Positions that are not finite are not changed.
        """
        if not len(self._joints) or not np.isfinite(given := q[self._joints]).all():
            return q
        turns = np.zeros(len(given))
        if self._last is not None and now - self._at < self._half_turn_s:
            turns = np.rint((self._last - given) / _TURN)
        self._last, self._at = given + _TURN * turns, now
        if not turns.any():
            return q
        q = q.copy()
        q[self._joints] = self._last
        return q

    def of_state(self, state: RobotState, now: float) -> RobotState:
        """Return the state with the positions of :meth:`counted`."""
        q = self.counted(state.q, now)
        return state if q is state.q else replace(state, q=q)
