"""A slow way home for the tools alone, of arms whose joints another controller moves."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.events import ReasonKind

_LINEAR_SPEED, _ANGULAR_SPEED = 0.1, 0.3  # [m/s], [rad/s]
_ARRIVED, _TURNED = 0.003, 0.01  # [m], [rad]
_PATIENCE = 5.0  # after the targets have arrived [s]


class ToolHoming:
    """Targets on a straight line from where the tools are to where they are at home, all arms at once.

    The QP keeps limits and distances on the way, and the posture's pull brings the elbows home; where it holds the
    tools up the homing ends there.
    """

    def __init__(self, home: Mapping[str, pin.SE3], tool_pose: Callable[[str], pin.SE3]) -> None:
        """``tool_pose``: where the controller's reference has an arm's tool."""
        self._home, self._tool_pose = dict(home), tool_pose
        self._start = {arm: tool_pose(arm) for arm in home}
        self._duration = max(self._needed(arm) for arm in home)
        self._time = 0.0

    def targets(self, dt: float) -> dict[str, pin.SE3 | None]:
        """Where the tools have to be after another ``dt`` [s]."""
        self._time += dt
        share = min(self._time / self._duration, 1.0)
        return {arm: _between(start, self._home[arm], share) for arm, start in self._start.items()}

    @property
    def outcome(self) -> ReasonKind | None:
        """How the homing ended, or None while it goes on."""
        if self._time < self._duration:
            return None
        errors = [self._tool_pose(arm).actInv(home) for arm, home in self._home.items()]
        ways = [(np.linalg.norm(error.translation), np.linalg.norm(pin.log3(error.rotation))) for error in errors]
        if all(way <= _ARRIVED and turn <= _TURNED for way, turn in ways):
            return ReasonKind.HOMING_ARRIVED
        return ReasonKind.HOMING_HELD_UP if self._time > self._duration + _PATIENCE else None

    def _needed(self, arm: str) -> float:
        start, home = self._start[arm], self._home[arm]
        way = float(np.linalg.norm(home.translation - start.translation))
        turn = float(np.linalg.norm(pin.log3(start.rotation.T @ home.rotation)))
        return max(way / _LINEAR_SPEED, turn / _ANGULAR_SPEED, 0.1)


def _between(start: pin.SE3, home: pin.SE3, share: float) -> pin.SE3:
    turn = pin.log3(start.rotation.T @ home.rotation)
    translation = start.translation + share * (home.translation - start.translation)
    return pin.SE3(start.rotation @ pin.exp3(share * turn), translation)
