"""What each arm has to do: its tool follows a checked target and its velocity, or its joints hold their positions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.closest_points import dot, size_of
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_pointers import pointer_to
from q2r2_control.control.tasks.built_in import TaskModel
from q2r2_control.control.tasks.frame import rotation_vector, times_transposed
from q2r2_control.errors import shown
from q2r2_control.types import Array

# Greatest coordinate of a target. It is larger than any cell, and squares of such numbers stay finite.
_FARTHEST = 100.0  # [m]
_ORTHONORMAL = 1e-3  # Largest permitted difference of R R' from the identity, for the rotation R of a target.
_AT_REST = 1e-2  # An arm whose joints are all slower than this counts as resting [rad/s].
_NONE, _POSE, _NO_POSE = 0, 1, 2  # What is offered to an arm as its target: nothing, a pose, or something else.
# If a target is faster than this multiple of the tool's speed limit, it has jumped.
_TELEPORT = 3.0


class PoseScratch(NamedTuple):
    """Buffers for the check of a pose that is offered as a target."""

    rotation: Array  # (3, 3)
    gram: Array  # (3, 3)
    correction: Array  # (3, 3)
    translation: Array  # (3,)
    moved: Array  # (6,)


class TaskTargets(NamedTuple):
    """The targets of all arms in one tick."""

    member: Array  # (n, nv) 1 if a joint belongs to the arm.
    follows: IntArray  # (n,) 1 if the tool follows its target, 0 if the arm's joints hold.
    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) [m]
    feed_forward: Array  # (n, 6) Smoothed twist of the target [m/s, rad/s].
    hold: Array  # (nv,) Joint positions to hold [rad].
    posture: Array  # (nv,) Posture to which joints move as far as the tools leave them free [rad].
    latched: IntArray  # (n,) 1 if the arm has come to rest where it holds.
    offered: IntArray  # (n,) What is offered in this tick: _NONE, _POSE or _NO_POSE.
    pose: Array  # (n, 4, 4) The offered pose as a homogeneous matrix, before it is checked.
    feed_forward_time: float  # Time constant that smooths the feed-forward [s].
    teleport_speed: float  # If a target moves faster than this, it has jumped [m/s].
    teleport_turn: float  # If a target turns faster than this, it has jumped [rad/s].
    scratch: PoseScratch

    @classmethod
    def empty(cls, model: TaskModel, settings: ControllerSettings) -> TaskTargets:
        n, nv = model.tools.member.shape
        return cls(
            member=model.tools.member,
            follows=np.zeros(n, dtype=np.int64),
            rotation=np.zeros((n, 3, 3)),
            translation=np.zeros((n, 3)),
            feed_forward=np.zeros((n, 6)),
            hold=np.zeros(nv),
            posture=model.posture.home.copy(),
            latched=np.zeros(n, dtype=np.int64),
            offered=np.zeros(n, dtype=np.int64),
            pose=np.zeros((n, 4, 4)),
            feed_forward_time=settings.feed_forward_time,
            teleport_speed=_TELEPORT * settings.max_linear_speed,
            teleport_turn=_TELEPORT * settings.max_angular_speed,
            scratch=PoseScratch(*np.zeros((3, 3, 3)), *np.zeros((1, 3)), *np.zeros((1, 6))),
        )


class TargetTracker:
    """Keeps the last usable target of each arm and the smoothed twist with which it moves (feed-forward)."""

    def __init__(self, model: TaskModel, arms: tuple[str, ...], settings: ControllerSettings) -> None:
        self._arms, self._home = arms, model.posture.home
        self._targets = TaskTargets.empty(model, settings)
        self._pose, self._offered = self._targets.pose, self._targets.offered
        self.pointer = pointer_to(self._targets)

    def reset(self, q: Array) -> None:
        """Forget all targets. Every arm holds at its present posture ``q`` (nv,) [rad]."""
        self._targets.latched[:] = 0
        self._targets.follows[:] = 0
        self._targets.hold[:] = q
        self._targets.posture[:] = self._home

    def hold_at(self, q: Array | None) -> None:
        """Let arms without a target move to ``q`` (nv,) [rad] and hold there; None lets them hold where they rest."""
        if q is None:
            self._targets.latched[:] = 0
        else:
            self._targets.hold[:] = q
            self._targets.latched[:] = 1

    def aim_posture(self, posture: npt.ArrayLike | None) -> None:
        """Let joints move to ``posture`` (nv,) [rad] as far as the tools leave them free; None stands for home.

        An invalid posture changes nothing.
        """
        if posture is None:
            self._targets.posture[:] = self._home
            return
        try:
            posture = np.asarray(posture)
        except Exception:  # Rows of different lengths raise an exception, and an object of the caller may raise any.
            return
        if posture.shape == self._home.shape and posture.dtype.kind in "fiu" and np.isfinite(posture).all():
            self._targets.posture[:] = posture

    def offer(self, targets: Mapping[str, pin.SE3 | None]) -> bool:
        """Write the targets of one tick for :func:`update_targets`. Return whether every key is the name of an arm."""
        known = 0
        for i, arm in enumerate(self._arms):
            target = targets.get(arm)
            if isinstance(target, pin.SE3):
                self._pose[i] = target.homogeneous
                self._offered[i] = _POSE
            else:
                self._offered[i] = _NONE if target is None else _NO_POSE
            known += arm in targets
        return known == len(targets)

    def rejected(self, targets: Mapping[str, pin.SE3 | None]) -> tuple[str, ...]:
        """Return the names of arms whose offered target is not usable, and the keys of ``targets`` that name no arm."""
        rejected = [arm for arm, offered in zip(self._arms, self._offered, strict=True) if offered == _NO_POSE]
        return (*rejected, *(str(name) for name in targets if name not in self._arms))

    def why_rejected(self, targets: Mapping[str, Any], rejected: tuple[str, ...]) -> tuple[str, ...]:
        """Return one line for each name that :meth:`rejected` returns, with what is allowed."""
        lines = []
        for name in rejected:
            if name not in self._arms:
                lines.append(f"target of {shown(name)}: no such arm; allowed: {', '.join(self._arms)}")
            elif isinstance(targets.get(name), pin.SE3):
                lines.append(f"target of {name}: allowed: finite numbers and a rotation")
            else:
                kind = type(targets.get(name)).__name__
                lines.append(f"target of {name} is of the type {kind}; allowed: a pinocchio.SE3, or None")
        return tuple(lines)


@kernel
def update_targets(targets: TaskTargets, q: Array, v: Array, dt: float) -> bool:
    """Make each offered pose the arm's target. Return False if some offered pose was not usable.

    An arm keeps its last target if the offered pose is not usable, which is marked in ``targets.offered``. An arm to
    which nothing is offered holds.
    """
    all_usable = True
    for i in range(targets.offered.shape[0]):
        if targets.offered[i] == _POSE and _update_pose(targets, i, dt):
            continue
        if targets.offered[i] == _NONE:
            if targets.follows[i] == 1:
                targets.follows[i] = 0
                targets.latched[i] = 0
        else:
            targets.offered[i] = _NO_POSE
            targets.feed_forward[i] = 0.0
            all_usable = False
        if targets.follows[i] == 0 and targets.latched[i] == 0:
            _hold(targets, i, q, v)
    return all_usable


@kernel
def _hold(targets: TaskTargets, i: int, q: Array, v: Array) -> None:
    """Let a moving arm brake first, and hold it where it comes to rest, so that it need not move back."""
    speed = 0.0
    for j in range(q.shape[0]):
        if targets.member[i, j] == 1.0:
            targets.hold[j] = q[j]
            speed = max(speed, abs(v[j]))
    if speed < _AT_REST:
        targets.latched[i] = 1


@kernel
def _update_pose(targets: TaskTargets, i: int, dt: float) -> bool:
    """Make the offered homogeneous pose the target of arm ``i``. Return False if it is not a finite pose.

    The twist of the target is smoothed with a time constant. If the target has jumped, faster than any tool can move,
    its twist counts as zero.
    """
    scratch = targets.scratch
    if not _checked_pose(targets.pose[i], scratch):
        return False
    moved = scratch.moved
    if targets.follows[i] == 1 and dt > 0.0:
        for k in range(3):
            moved[k] = (scratch.translation[k] - targets.translation[i, k]) / dt
        times_transposed(scratch.rotation, targets.rotation[i], scratch.gram)
        turned = moved[3:6]
        rotation_vector(scratch.gram, turned)
        for k in range(3):
            turned[k] /= dt
        put_elsewhere = size_of(moved[0:3]) > targets.teleport_speed or size_of(turned) > targets.teleport_turn
        share = 1.0 - np.exp(-dt / targets.feed_forward_time)
        for k in range(6):
            velocity = 0.0 if put_elsewhere else moved[k]
            targets.feed_forward[i, k] += share * (velocity - targets.feed_forward[i, k])
    else:
        targets.feed_forward[i] = 0.0
    targets.follows[i] = 1
    for row in range(3):
        targets.translation[i, row] = scratch.translation[row]
        for column in range(3):
            targets.rotation[i, row, column] = scratch.rotation[row, column]
    return True


@kernel
def _checked_pose(pose: Array, scratch: PoseScratch) -> bool:
    """Write translation and rotation of a ``pose`` (4, 4) into ``scratch``. Return False if it is not a finite pose.

    A Newton step makes the written rotation orthonormal.
    """
    rotation, translation, gram = scratch.rotation, scratch.translation, scratch.gram
    largest, total, error = 0.0, 0.0, 0.0
    for i in range(3):
        for j in range(3):
            rotation[i, j] = pose[i, j]
        translation[i] = pose[i, 3]
        largest = max(largest, abs(translation[i]))
        total += translation[i]
    times_transposed(rotation, rotation, gram)
    for i in range(3):
        gram[i, i] -= 1.0
        for j in range(3):
            total += gram[i, j]
            error = max(error, abs(gram[i, j]))
    determinant = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        determinant += rotation[0, i] * (rotation[1, j] * rotation[2, k] - rotation[1, k] * rotation[2, j])
    # A maximum may ignore NaN, but the sum is not finite if a number is NaN or infinite.
    if not (np.isfinite(total) and error < _ORTHONORMAL and determinant > 0.0):
        return False
    if largest > _FARTHEST:
        for i in range(3):
            translation[i] *= _FARTHEST / largest
    # A Newton step towards the nearest rotation, R - (R R' - I) R / 2 (Higham, Functions of Matrices, 2008, eq. 8.20).
    for i in range(3):
        for j in range(3):
            scratch.correction[i, j] = 0.5 * dot(gram[i], rotation[:, j])
    rotation -= scratch.correction
    return True
