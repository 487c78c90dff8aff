"""Estimate from measured postures how far each arm lags behind the reference, if its driver does not report this."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_MAX_LAG_S = 0.4
# Two past postures of the reference fit a measured arm equally well if their distances from it differ by at most this
# [rad].
_SAME_FIT = 0.005


class MeasuredLags:
    """Remembers the reference, and finds the time at which the reference was where an arm is measured now.

    If an arm passes the same posture twice, or if its reference hardly moves, several lags are possible. In that case
    the possible lags of the arms that are nearest to each other are chosen. The lags then differ only if the measured
    postures allow no other explanation.
    """

    def __init__(self, robot: Robot) -> None:
        self._joints = {arm: its.joints for arm, its in robot.arms.items()}
        self._past: deque[tuple[float, Array]] = deque()

    def restart(self) -> None:
        """Forget the past, because the reference begins again."""
        self._past.clear()

    def note(self, q: Array, now: float) -> None:
        """Remember that the reference is at ``q`` (nv,) [rad] at time ``now`` [s]."""
        self._past.append((now, q))
        while self._past[0][0] < now - _MAX_LAG_S:
            self._past.popleft()

    def behind(self, q: Array, measured: Mapping[str, float]) -> dict[str, float]:
        """Return the lag of each arm [s]; 0 if there is no reference yet.

        Args:
            q: Measured posture (nv,) [rad].
            measured: For each arm, the time at which its joints in ``q`` were measured [s].
        """
        if not self._past:
            return dict.fromkeys(measured, 0.0)
        times, postures = np.array([t for t, _ in self._past]), np.array([place for _, place in self._past])
        found = {arm: self._possible(arm, t, times, postures, q) for arm, t in measured.items()}
        # Each arm has a smallest possible lag. This is the largest of these lags.
        reached = max(float(lags.min()) for lags in found.values())
        return {arm: float(lags[np.abs(lags - reached).argmin()]) for arm, lags in found.items()}

    def _possible(self, arm: str, measured: float, times: Array, postures: Array, q: Array) -> Array:
        """Return all lags (k,) [s] that explain the posture of an arm that was measured at time ``measured`` [s]."""
        joints = self._joints[arm]
        off = np.sqrt(np.square(postures[:, joints] - q[joints]).sum(axis=1))
        return np.maximum(measured - times[off <= off.min() + _SAME_FIT], 0.0)
