"""Count the turns of continuous joints, whose angle may be reported within one turn, as in (-pi, pi].

If the angle jumps by a whole turn between two reports, the joint has not jumped. This is certain if the joint cannot
have turned by half a turn between the two reports. Reports that count turns themselves are not changed. The first
report is not changed either, nor is a report after a time in which the joint can have turned by half a turn.
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
        self._half_turn_s = math.pi / robot.velocity_limit[joints]
        self._last = np.zeros(len(joints))  # The last positions of these joints with their turns [rad].
        self._at = np.full(len(joints), -math.inf)  # The times at which they were measured [s].

    def counted(self, q: Array, at: float | Array) -> Array:
        """Return the reported positions ``q`` (nv,) [rad] with the turns of continuous joints.

        ``at`` is the time of the measurement [s]: one time, or one for each joint (nv,). If nothing changes, ``q``
        itself is returned. Positions that are not finite are not changed.
        """
        if not len(self._joints) or not np.isfinite(given := q[self._joints]).all():
            return q
        at = np.broadcast_to(at, q.shape)[self._joints]
        turns = np.where(at - self._at < self._half_turn_s, np.rint((self._last - given) / _TURN), 0.0)
        self._last, self._at = given + _TURN * turns, at.copy()
        if not turns.any():
            return q
        q = q.copy()
        q[self._joints] = self._last
        return q

    def of_state(self, state: RobotState) -> RobotState:
        """Return the state with positions as :meth:`counted` returns them.

        Whole turns are added to the posture ``held``, so that it is within half a turn of these positions.
        """
        q, held = self.counted(state.q, state.stamp), state.held
        if held is not None and len(joints := self._joints):
            held = held.copy()
            held[joints] += _TURN * np.rint((q[joints] - held[joints]) / _TURN)
        return state if q is state.q and held is state.held else replace(state, q=q, held=held)
