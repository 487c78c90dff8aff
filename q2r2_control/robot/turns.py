"""Joints that turn on for ever, whose angle may be reported within one turn, as in (-pi, pi]: their turns are counted.

A jump by a whole turn between two reports is none, as long as the joint cannot have turned by half of one meanwhile.
Reports that count turns themselves stay as they are. So does the first one, and one after a longer gap.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState

_TURN = 2.0 * math.pi


class TurnCounter:
    """Counts the turns of a robot's endless joints, from one measured state to the next."""

    def __init__(self, robot: Robot) -> None:
        joints = self._joints = np.flatnonzero(robot.endless)
        self._half_turn_s = float((math.pi / robot.velocity_limit[joints]).min(initial=math.inf))
        self._last: Array | None = None  # of these joints, as counted [rad]
        self._at = -math.inf

    def counted(self, q: Array, now: float) -> Array:
        """``q`` (nv,) as reported at ``now`` [s], with endless joints near where they were; no copy without a change.

        Positions that are not finite are left for others to judge.
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
        """The state with its positions :meth:`counted`."""
        q = self.counted(state.q, now)
        return state if q is state.q else replace(state, q=q)
