"""Keep recent postures of the reference, at which delayed arms may still be, for arm_skew.py (compiled)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.kernel_pointers import KernelPointers, pointers_to
from q2r2_control.types import Array

LONGEST_WINDOW = 0.1  # The longest time for which past postures are kept [s].
_POSTURES = 21  # Number of past postures that are kept.
_SPACING = LONGEST_WINDOW / (_POSTURES - 1)  # Time between two postures, if steps are not longer [s].
_LONG_AGO = 1e3  # The age of the postures of arms that have always rested [s].


class ReferenceHistory(NamedTuple):
    """Recent postures of the reference, sorted from the newest to the oldest."""

    window: Array  # (2,) The present window, and the requested window [s]; 0 if all arms move at the same time.
    q: Array  # (m, nv) [rad]
    v: Array  # (m, nv) [rad/s]
    a: Array  # (m, nv) Greatest acceleration from each posture to the next newer one [rad/s^2].
    age: Array  # (m,) Age of each posture [s].
    known: Array  # (m,) 1 if ``samples`` contains the poses of the bodies at a posture, 0 if they are not computed yet.
    samples: KernelPointers  # (m,) CollisionData at each posture.
    counted: IntArray  # (1,) Number of postures in the window.
    time: Array  # (1,) Age of the oldest posture in the window [s].
    travel: Array  # (nv,) Greatest distance of a joint in the window from its present position [rad or m].
    # (nv,) Greatest deviation of a joint in the window from motion at its present velocity, plus the effect of turning
    # [rad or m].
    off: Array
    speed: Array  # (nv,) Greatest speed of a joint in the window [rad/s].
    # (3, nv) How much each joint makes a body's corner leave a straight line between two instants [rad or m]. The first
    # row is for the window. The second row is for the whole path with instants that are far apart, and the third row is
    # for the whole path with instants that are close together.
    bend: Array
    deviation: Array  # (nv,) As ``off``, but on the whole path: window, step and stop [rad or m].

    @classmethod
    def empty(cls, model: CollisionModel, shared: CollisionData) -> ReferenceHistory:
        """Return a history of arms that rest at q = 0. The samples use the rotations and the contact of ``shared``."""
        nv = len(model.chain.parent) - 1
        samples = []
        for _ in range(_POSTURES):
            sample = CollisionData.empty(model)
            placements = sample.placements._replace(rotation=shared.placements.rotation)
            samples.append(sample._replace(placements=placements, contact=shared.contact))
        return cls(
            window=np.zeros(2),
            q=np.zeros((_POSTURES, nv)),
            v=np.zeros((_POSTURES, nv)),
            a=np.zeros((_POSTURES, nv)),
            age=np.full(_POSTURES, _LONG_AGO),
            known=np.zeros(_POSTURES),
            samples=pointers_to(samples),
            counted=np.zeros(1, dtype=np.int64),
            time=np.zeros(1),
            travel=np.zeros(nv),
            off=np.zeros(nv),
            speed=np.zeros(nv),
            bend=np.zeros((3, nv)),
            deviation=np.zeros(nv),
        )

    @property
    def kept(self) -> tuple[Array, ...]:
        """The arrays from which all others are computed."""
        return self.window, self.q, self.v, self.a, self.age


@kernel
def rest_always(history: ReferenceHistory, q: Array) -> None:
    """Write the history of arms that have always rested at ``q`` (nv,)."""
    history.window[0] = history.window[1]
    for i in range(history.age.shape[0]):
        history.age[i] = _LONG_AGO
        for j in range(q.shape[0]):
            history.q[i, j], history.v[i, j], history.a[i, j] = q[j], 0.0, 0.0


@kernel
def remember(history: ReferenceHistory, q: Array, v: Array, v_next: Array, h: float) -> None:
    """Remember the reference ``q``, ``v`` (nv,) before a step of ``h`` [s] that leads to the velocities ``v_next``."""
    if history.window[1] == 0.0:
        history.window[0] = 0.0
        return
    if history.age[0] + h > _SPACING:
        for i in range(history.age.shape[0] - 1, 0, -1):
            history.age[i] = history.age[i - 1]
            for j in range(q.shape[0]):
                history.q[i, j], history.v[i, j], history.a[i, j] = (
                    history.q[i - 1, j],
                    history.v[i - 1, j],
                    history.a[i - 1, j],
                )
        history.age[0] = 0.0
        for j in range(q.shape[0]):
            history.q[0, j], history.v[0, j], history.a[0, j] = q[j], v[j], 0.0
    for j in range(q.shape[0]):
        if h > 0.0:
            history.a[0, j] = max(history.a[0, j], abs(v_next[j] - v[j]) / h)
    for i in range(history.age.shape[0]):
        history.age[i] += h
    history.window[0] = min(history.window[1], history.window[0] + h)


@kernel
def look_back(model: CollisionModel, history: ReferenceHistory, q: Array, v: Array) -> None:
    """Compute how far from the present reference ``q``, ``v`` (nv,) the joints were in the window."""
    if history.window[0] == 0.0 and history.counted[0] == 0:
        return  # All arms move at the same time, and all results are 0 already.
    history.counted[0], history.time[0] = 0, 0.0
    history.travel[:], history.off[:], history.speed[:], history.bend[0, :] = 0.0, 0.0, 0.0, 0.0
    longest, newer, window = 0.0, 0.0, history.window[0]
    for i in range(history.age.shape[0]):
        if newer >= window:
            break
        history.known[i], history.counted[0] = 0.0, i + 1
        moved = False
        for j in range(q.shape[0]):
            later = v[j] if i == 0 else history.v[i - 1, j]
            moved |= history.v[i, j] != 0.0 or history.a[i, j] != 0.0 or later != 0.0
        # If the arms have not moved since a posture, the age of this posture is limited to the window.
        age = history.age[i] if moved else min(history.age[i], max(newer, window))
        if moved:
            longest = max(longest, age - newer)
            for j in range(q.shape[0]):
                later = v[j] if i == 0 else history.v[i - 1, j]
                speed = max(abs(history.v[i, j]), abs(later)) + 0.5 * history.a[i, j] * (age - newer)
                history.speed[j] = max(history.speed[j], speed)
                history.bend[0, j] = max(history.bend[0, j], history.a[i, j])
        for j in range(q.shape[0]):
            way = history.q[i, j] - q[j]
            history.travel[j] = max(history.travel[j], abs(way))
            history.off[j] = max(history.off[j], abs(way + v[j] * age))
        newer = age
    history.time[0] = newer
    share = 0.125 * longest * longest
    for j in range(q.shape[0]):
        bent = share * history.bend[0, j]
        history.travel[j] += bent
        history.off[j] += bent
        history.bend[0, j] = bent + share * turning(model, history.speed, j)
    for j in range(q.shape[0]):
        history.off[j] += 0.5 * turning(model, history.travel, j)


@inlined_kernel
def turning(model: CollisionModel, way: Array, j: int) -> float:
    """Return w_j (w_j + 2 sum_(i before j) w_i) for the motions w = ``way`` (nv,) of all joints.

    This number times reach_j bounds how much joint ``j`` bends the path of a corner, see separating_plane.py.
    """
    before = 0.0
    joint = model.chain.parent[j + 1]
    while joint != 0:
        before += way[joint - 1]
        joint = model.chain.parent[joint]
    return way[j] * (way[j] + 2.0 * before)
