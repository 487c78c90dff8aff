"""What each arm is asked to do: checked targets, their own velocity, and what a held arm holds."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.control.jit import Held, hold, kernel
from q2r2_control.control.settings import ControllerSettings
from q2r2_control.control.tasks import rotation_vector
from q2r2_control.control.workspace import Cell, Goals
from q2r2_control.types import Array

# Farther than any cell; keeps squares of what is merely far away finite.
_FARTHEST = 100.0  # [m]
_ORTHONORMAL = 1e-3
# A target faster than this many times the tool's own limit did not move, it was put elsewhere.
_TELEPORT = 3.0
_AT_REST = 1e-2  # [rad/s]


class GoalTracker:
    """Keeps the last usable target of each arm and the smoothed twist with which it moves (feed-forward)."""

    def __init__(self, cell: Cell, arms: tuple[str, ...], settings: ControllerSettings) -> None:
        self._arms = arms
        self._members = [np.flatnonzero(member) for member in cell.tools.member]
        self._time = settings.feed_forward_time
        self._fastest = _TELEPORT * np.array([settings.max_linear_speed, settings.max_angular_speed])
        self._latched = [False] * len(arms)
        self._goals = Goals.empty(cell)
        self.held = hold(self._goals)

    def reset(self, q: Array) -> None:
        """Forget all targets; every arm holds where it is, ``q`` (nv,) [rad]."""
        self._latched = [False] * len(self._arms)
        self._goals.follows[:] = 0
        self._goals.hold[:] = q

    def update(self, targets: Mapping[str, pin.SE3 | None], dt: float, q: Array, v: Array) -> tuple[str, ...]:
        """Take the targets of one tick; returns the names whose target is not usable, unknown names among them."""
        rejected = []
        for i, arm in enumerate(self._arms):
            target = targets.get(arm)
            if target is None:
                self._hold(i, q, v)
            elif not isinstance(target, pin.SE3) or not take_target(
                self.held, i, target.homogeneous, dt, self._time, self._fastest
            ):
                rejected.append(arm)
                if self._goals.follows[i] == 0:
                    self._hold(i, q, v)
        if len(targets) > len(self._arms) or any(name not in self._arms for name in targets):
            rejected.extend(str(name) for name in targets if name not in self._arms)
        return tuple(rejected)

    def _hold(self, i: int, q: Array, v: Array) -> None:
        """A moving arm is braked first and holds where it comes to rest, so that it need not come back."""
        if self._goals.follows[i] == 1:
            self._goals.follows[i] = 0
            self._latched[i] = False
        if not self._latched[i]:
            joints = self._members[i]
            self._goals.hold[joints] = q[joints]
            self._latched[i] = bool(np.abs(v[joints]).max() < _AT_REST)


@kernel
def take_target(held_goals: Held, i: int, pose: Array, dt: float, time: float, fastest: Array) -> bool:
    """Make the homogeneous ``pose`` (4, 4) the goal of arm ``i``; False, and no change, if it is not a finite pose.

    A goal that moves has its twist smoothed over ``time`` [s]; one that was put elsewhere, faster than ``fastest``
    (2,) [m/s, rad/s], has none.
    """
    goals = held_goals.value
    rotation = np.empty((3, 3))
    translation = np.empty(3)
    if not _checked_pose(pose, rotation, translation):
        goals.feed_forward[i] = 0.0
        return False
    moved = np.zeros(6)
    if goals.follows[i] == 1 and dt > 0.0:
        for k in range(3):
            moved[k] = (translation[k] - goals.translation[i, k]) / dt
        rotation_vector(_times_transposed(rotation, goals.rotation[i]), moved[3:6])
        moved[3:6] /= dt
        if np.sqrt(np.sum(moved[0:3] ** 2)) > fastest[0] or np.sqrt(np.sum(moved[3:6] ** 2)) > fastest[1]:
            moved[:] = 0.0
        share = 1.0 - np.exp(-dt / time)
        for k in range(6):
            goals.feed_forward[i, k] += share * (moved[k] - goals.feed_forward[i, k])
    else:
        goals.feed_forward[i] = 0.0
    goals.follows[i] = 1
    goals.rotation[i] = rotation
    goals.translation[i] = translation
    return True


@kernel
def _times_transposed(A: Array, B: Array) -> Array:
    """A B' of two 3 by 3 matrices."""
    product = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                product[i, j] += A[i, k] * B[j, k]
    return product


@kernel
def _checked_pose(pose: Array, rotation: Array, translation: Array) -> bool:
    """Split a pose (4, 4), the rotation made orthonormal; False for what is not finite or no rotation."""
    for i in range(3):
        for j in range(3):
            rotation[i, j] = pose[i, j]
        translation[i] = pose[i, 3]
    largest = np.max(np.abs(translation))
    gram = _times_transposed(rotation, rotation)
    for i in range(3):
        gram[i, i] -= 1.0
    determinant = (
        rotation[0, 0] * (rotation[1, 1] * rotation[2, 2] - rotation[1, 2] * rotation[2, 1])
        - rotation[0, 1] * (rotation[1, 0] * rotation[2, 2] - rotation[1, 2] * rotation[2, 0])
        + rotation[0, 2] * (rotation[1, 0] * rotation[2, 1] - rotation[1, 1] * rotation[2, 0])
    )
    # Written so that NaN, which fails every comparison, is refused.
    usable = np.isfinite(np.sum(translation)) and np.max(np.abs(gram)) < _ORTHONORMAL and determinant > 0.0
    if not (usable and np.isfinite(np.sum(gram))):
        return False
    if largest > _FARTHEST:
        for i in range(3):
            translation[i] *= _FARTHEST / largest
    # A Newton step towards the nearest rotation, R - (R R' - I) R / 2 (Higham, Functions of Matrices, 2008, eq. 8.20).
    correction = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                correction[i, j] += 0.5 * gram[i, k] * rotation[k, j]
    for i in range(3):
        for j in range(3):
            rotation[i, j] -= correction[i, j]
    return True
