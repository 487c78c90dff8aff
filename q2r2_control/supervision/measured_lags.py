"""How far arms are behind the reference by where they are measured, for drivers that do not tell."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_LONGEST = 0.4  # lag that is looked for [s]
# Places of the reference that are farther from a measured arm than the nearest one by less may be where it is [rad].
_SAME_PLACE = 0.005


class MeasuredLags:
    """Remembers the reference, and finds the time at which it was where an arm is measured.

    An arm that came along the same way twice, or whose reference hardly moves, may be at several times of it. Then the
    times count that are nearest to each other: only what cannot be explained otherwise is a difference.
    """

    def __init__(self, robot: Robot) -> None:
        self._joints = {arm: its.joints for arm, its in robot.arms.items()}
        self._past: deque[tuple[float, Array]] = deque()

    def restart(self) -> None:
        """The reference begins anew."""
        self._past.clear()

    def note(self, q: Array, now: float) -> None:
        """The reference is to be at ``q`` (nv,) at ``now`` [s]."""
        self._past.append((now, q))
        while self._past[0][0] < now - _LONGEST:
            self._past.popleft()

    def behind(self, q: Array, measured: Mapping[str, float]) -> dict[str, float]:
        """The lag [s] of arms that were measured at ``q`` (nv,), each at a time [s]; 0 without a reference."""
        if not self._past:
            return dict.fromkeys(measured, 0.0)
        times, places = np.array([t for t, _ in self._past]), np.array([place for _, place in self._past])
        found = {arm: self._possible(arm, t, times, places, q) for arm, t in measured.items()}
        reached = max(float(lags.min()) for lags in found.values())  # by the arm that is behind most, at the least
        return {arm: float(lags[np.abs(lags - reached).argmin()]) for arm, lags in found.items()}

    def _possible(self, arm: str, measured: float, times: Array, places: Array, q: Array) -> Array:
        """All lags [s] that explain where an arm was ``measured``."""
        joints = self._joints[arm]
        off = np.sqrt(np.square(places[:, joints] - q[joints]).sum(axis=1))
        return np.maximum(measured - times[off <= off.min() + _SAME_PLACE], 0.0)
