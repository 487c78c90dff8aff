"""Interpolate targets that come less often than the controller's steps, such as the targets of a tracker.

If a target is held until the next target comes, it stands still in most steps, and jumps in one of them. At each jump,
the controller would move some joint at its acceleration limit. Here, poses between the earlier and the newest target
are interpolated: on a straight line, with a constant angular velocity. The interpolation takes 1.25 times as long as
the earlier target was held, so the newest target is reached only after this time. A target that changes at every step,
or after more than :data:`LONGEST_HOLD`, is passed on at once.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

LONGEST_HOLD = 0.11  # If a target was held for longer than this, it belonged to no stream of targets [s].
# Duration of an interpolation, divided by the time for which the earlier target was held. With 1.25, the next target
# may be late by a quarter of this time.
_SPARE = 1.25
_FARTHEST = 1e3  # Largest coordinate of a target that is interpolated. No arm could reach farther [m].
# Largest difference of R R' from the identity, for the rotation R of a target that is interpolated. The controller
# itself refuses targets for which this difference is more than twice as large.
_ORTHONORMAL = 5e-4
_STEPS = 1.5  # If a target changes after fewer steps than this, targets count as new at every step.


@dataclass(slots=True)
class _TargetPath:
    """The path of one arm's target from an earlier pose to the newest target."""

    start: pin.SE3
    goal: pin.SE3
    duration: float = 0.0  # [s]
    held: float = 0.0  # Time for which the caller has given the same goal [s].

    def begin(self, goal: pin.SE3, dt: float) -> None:
        """Begin a path to a new ``goal``, with steps of ``dt`` [s].

        The duration is 0 unless the last goal was held for some steps, and both goals can be interpolated.
        """
        if _STEPS * dt < self.held <= LONGEST_HOLD and _is_ordinary(self.goal) and _is_ordinary(goal):
            self.start, self.duration = self.now(), _SPARE * self.held
        else:
            self.duration = 0.0
        self.goal, self.held = goal, 0.0

    def now(self) -> pin.SE3:
        if self.held >= self.duration:
            return self.goal
        part, turn = self.held / self.duration, pin.log3(self.start.rotation.T @ self.goal.rotation)
        rotation = self.start.rotation @ pin.exp3(part * turn)
        return pin.SE3(rotation, self.start.translation + part * (self.goal.translation - self.start.translation))


class HeldTargets:
    """The targets of all arms.

    While a caller gives the same target for an arm, poses between the previous target and this target are returned.
    """

    def __init__(self) -> None:
        self._paths: dict[str, _TargetPath] = {}

    def clear(self) -> None:
        """Forget all targets."""
        self._paths.clear()

    def between(self, targets: Mapping[str, pin.SE3 | None], dt: float) -> dict[str, pin.SE3 | None]:
        """Return the targets to follow in a step of ``dt`` [s].

        While the caller gives the same pose for an arm, the arm's targets are interpolated. They lead from the pose
        that the caller gave before to this pose.
        """
        found: dict[str, pin.SE3 | None] = {}
        for arm, pose in targets.items():
            path = self._paths.get(arm)
            if not isinstance(pose, pin.SE3):
                self._paths.pop(arm, None)
                found[arm] = pose
                continue
            if path is None:
                path = self._paths[arm] = _TargetPath(pose, pose.copy())
            elif pose != path.goal:
                path.begin(pose.copy(), dt)
            path.held += dt
            found[arm] = pose if path.held >= path.duration else path.now()
        if len(found) < len(self._paths):
            self._paths = {arm: path for arm, path in self._paths.items() if arm in found}
        return found

    def peek(self, targets: Mapping[str, pin.SE3 | None], dt: float) -> dict[str, pin.SE3 | None]:
        """Return what :meth:`between` would return, and leave this instance as it is."""
        kept = self._paths
        try:
            self._paths = {arm: copy.copy(path) for arm, path in kept.items()}
            return self.between(targets, dt)
        finally:
            self._paths = kept


def _is_ordinary(pose: pin.SE3) -> bool:
    """Return whether the pose has finite numbers and a rotation, so that it can be interpolated."""
    rotation = pose.rotation
    # The comparisons are written so that NaN fails them too.
    if not (np.abs(rotation).max() < 2.0 and np.abs(pose.translation).max() < _FARTHEST):
        return False
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() < _ORTHONORMAL and np.linalg.det(rotation) > 0.0)
