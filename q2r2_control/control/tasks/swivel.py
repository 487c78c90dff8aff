"""The swivel of an arm's elbow about the line from shoulder to wrist, and posture velocities that turn it, compiled.

With shoulder S, elbow E, wrist W, w = (W - S) / |W - S|, e = E - S and V pointing up, the elbow's offset from the line
is p = e - (w'e) w and that of V is l = V - (w'V) w. The swivel angle is the angle from l to p about w,

    psi = atan2(w'(V x p), V'p)

(Kreutz-Delgado, Long, Seraji, Int. J. Robotics Research 11(5), 1992). With t_p = w x p / |p| and t_l = w x l / |l|,

    dpsi = t_p'de / |p| + ((w'V) / |l| t_l - (w'e) / |p| t_p)' dw',    dw' = d(W - S) / |W - S|.

It is not defined for a stretched arm (p = 0) nor for a wrist straight above or below the shoulder (l = 0); the task
fades out towards both.

The elbow turns in the tool's nullspace, through the posture velocity: as a cost of its own it would have to be paid
for by the tool wherever tool and elbow cannot both have their way, which is what the nullspace excludes. An arm with
one joint to spare has no more than this one motion there, so the task takes the place of the pull towards home and of
manipulability, which have their say as it fades out.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp, dot
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements, place
from q2r2_control.control.jit import kernel
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

if TYPE_CHECKING:  # these are made of what this module defines
    from q2r2_control.control.tasks.task_data import TaskData, TaskTargets
    from q2r2_control.control.tasks.task_model import TaskModel

# Below these the task fades out: |p|, and |l|, the sine of the angle between the line and V.
_FULL_RADIUS = 0.05  # [m]
_FULL_SINE = 0.2
_TINY = 1e-9
# Keeps the velocity finite where the nullspace does not turn the elbow.
_DAMPING = 1e-6


class Swivels(NamedTuple):
    """The swivel task of each arm. A point is on its joint's axis, ``along`` it from the joint's origin."""

    joint: IntArray  # (n, 3) joints of shoulder, elbow, wrist
    along: Array  # (n, 3) [m]
    angle: Array  # (n,) wanted [rad]
    gain: Array  # (n,) [1/s]; 0: no task

    @classmethod
    def none(cls, n: int) -> Swivels:
        return cls(np.zeros((n, 3), dtype=np.int64), np.zeros((n, 3)), np.zeros(n), np.zeros(n))


class SwivelScratch(NamedTuple):
    """Vectors of one arm's swivel, and the row of each arm."""

    points: Array  # (3, 3) S, E, W
    line: Array  # (3,) w
    offset: Array  # (3,) p, then t_p
    reference: Array  # (3,) l, then t_l
    by_elbow: Array  # (3,) dpsi / de
    by_wrist: Array  # (3,) dpsi / d(W - S)
    row: Array  # (nv,) of all arms
    free: Array  # (nv,) its part in the tools' nullspace
    rate: Array  # (n,)
    share: Array  # (n,)

    @classmethod
    def empty(cls, n: int, nv: int) -> SwivelScratch:
        return cls(
            points=np.zeros((3, 3)),
            line=np.zeros(3),
            offset=np.zeros(3),
            reference=np.zeros(3),
            by_elbow=np.zeros(3),
            by_wrist=np.zeros(3),
            row=np.zeros(nv),
            free=np.zeros(nv),
            rate=np.zeros(n),
            share=np.zeros(n),
        )


def swivels_of(robot: Robot, chain: Chain) -> Swivels:
    """The arms' swivel tasks; without an angle of its own, a task keeps that of the home posture."""
    n, nv = len(robot.arms), robot.model.nv
    swivels, placements, scratch = Swivels.none(n), Placements.empty(chain), SwivelScratch.empty(n, nv)
    place(chain, np.array(robot.home, dtype=np.float64), placements)
    for i, arm in enumerate(robot.arms.values()):
        if arm.swivel is None:
            continue
        swivels.gain[i] = arm.swivel.gain
        for k, name in enumerate((arm.swivel.shoulder, arm.swivel.elbow, arm.swivel.wrist)):
            swivels.joint[i, k] = robot.model.getJointId(name)
            swivels.along[i, k] = nearest_along(chain, int(swivels.joint[i, k]))
        at_home, _ = swivel_angle(placements, swivels, i, scratch)
        swivels.angle[i] = at_home if arm.swivel.angle is None else arm.swivel.angle
    return swivels


def nearest_along(chain: Chain, joint: int) -> float:
    """Where on ``joint``'s axis, from its origin [m], the next joint's axis is nearest.

    It is the centre of a spherical shoulder or wrist, wherever on its axis a description puts the joint's origin.
    """
    following = np.flatnonzero(chain.parent == joint)
    following = following[following != 0]
    if len(following) != 1:
        return 0.0
    child = int(following[0])
    axis, other = chain.axis[joint], chain.rotation[child] @ chain.axis[child]
    between, cosine = chain.translation[child], float(axis @ other)
    if 1.0 - cosine * cosine < _TINY:
        return 0.0
    return float((axis @ between - cosine * (other @ between)) / (1.0 - cosine * cosine))


@kernel
def swivel_angle(placements: Placements, swivels: Swivels, i: int, scratch: SwivelScratch) -> tuple[float, float]:
    """Swivel angle of arm ``i`` in (-pi, pi] [rad], and the share of 0 .. 1 to which it is well defined."""
    points, line, offset, reference = scratch.points, scratch.line, scratch.offset, scratch.reference
    for k in range(3):
        joint = swivels.joint[i, k]
        for c in range(3):
            points[k, c] = placements.translation[joint, c] + swivels.along[i, k] * placements.axis[joint, c]
    for c in range(3):
        line[c] = points[2, c] - points[0, c]
    length = np.sqrt(dot(line, line))
    if length < _TINY:
        return 0.0, 0.0
    for c in range(3):
        line[c] /= length
        offset[c] = points[1, c] - points[0, c]
    beside = dot(line, offset)
    for c in range(3):
        offset[c] -= beside * line[c]
        reference[c] = (1.0 if c == 2 else 0.0) - line[2] * line[c]
    radius, sine = np.sqrt(dot(offset, offset)), np.sqrt(dot(reference, reference))
    if radius < _TINY or sine < _TINY:
        return 0.0, 0.0
    # V = (0, 0, 1): V x p = (-p_y, p_x, 0)
    angle = math.atan2(line[1] * offset[0] - line[0] * offset[1], offset[2])
    return angle, clamp(radius / _FULL_RADIUS, 0.0, 1.0) * clamp(sine / _FULL_SINE, 0.0, 1.0)


@kernel
def swivel_row(
    chain: Chain, placements: Placements, swivels: Swivels, i: int, scratch: SwivelScratch
) -> tuple[float, float, float]:
    """Gradient of arm ``i``'s swivel angle times a size, added to ``scratch.row`` (nv,), which stays finite.

    Returns the angle, the share to which it is well defined, and the size, |p| |l| [m]; share and size are 0, and
    nothing is written, where the angle is not defined.
    """
    angle, share = swivel_angle(placements, swivels, i, scratch)
    if share == 0.0:
        return angle, 0.0, 0.0
    points, line = scratch.points, scratch.line
    length = 0.0
    beside = 0.0
    for c in range(3):
        length += line[c] * (points[2, c] - points[0, c])
        beside += line[c] * (points[1, c] - points[0, c])
    up = line[2]
    radius = _turned(line, scratch.offset)
    sine = _turned(line, scratch.reference)
    for c in range(3):
        scratch.by_elbow[c] = sine * scratch.offset[c]
        scratch.by_wrist[c] = (up * radius * scratch.reference[c] - beside * sine * scratch.offset[c]) / length
    for k in range(3):
        joint = chain.parent[swivels.joint[i, k]]  # the point lies on its own joint's axis, which does not move it
        while joint != 0:
            for c in range(3):
                if k == 0:
                    weight = -scratch.by_elbow[c] - scratch.by_wrist[c]
                else:
                    weight = scratch.by_elbow[c] if k == 1 else scratch.by_wrist[c]
                scratch.row[joint - 1] += weight * _point_rate(chain, placements, joint, points[k], c)
            joint = chain.parent[joint]
    return angle, share, radius * sine


@kernel
def _turned(line: Array, offset: Array) -> float:
    """Replace ``offset``, across the unit vector ``line``, by line x offset / |offset|; returns |offset|."""
    size = np.sqrt(dot(offset, offset))
    x, y, z = offset[0] / size, offset[1] / size, offset[2] / size
    offset[0] = line[1] * z - line[2] * y
    offset[1] = line[2] * x - line[0] * z
    offset[2] = line[0] * y - line[1] * x
    return size


@kernel
def _point_rate(chain: Chain, placements: Placements, joint: int, point: Array, c: int) -> float:
    """Component ``c`` of a point's velocity per velocity of ``joint``, which carries it."""
    axis = placements.axis[joint]
    if chain.prismatic[joint] == 1:
        return axis[c]
    origin = placements.translation[joint]
    a, b = (c + 1) % 3, (c + 2) % 3
    return axis[a] * (point[b] - origin[b]) - axis[b] * (point[a] - origin[a])


@kernel
def write_swivel_rows(model: TaskModel, data: TaskData, targets: TaskTargets) -> None:
    """Rows, rates [rad/s times the row's size] and shares of all arms that have the task and follow a target."""
    swivels, scratch, fastest = model.swivels, data.swivel, model.posture.speed
    scratch.row[:] = 0.0
    for i in range(swivels.gain.shape[0]):
        scratch.share[i] = 0.0
        if swivels.gain[i] == 0.0 or targets.follows[i] == 0:
            continue
        angle, share, size = swivel_row(model.chain, data.placements, swivels, i, scratch)
        error = swivels.angle[i] - angle
        error -= 2.0 * np.pi * np.round(error / (2.0 * np.pi))
        scratch.share[i] = share
        scratch.rate[i] = size * clamp(swivels.gain[i] * error, -fastest, fastest)
    for j in range(scratch.row.shape[0]):
        scratch.free[j] = scratch.row[j]


@kernel
def turn_elbows(model: TaskModel, data: TaskData) -> None:
    """Let ``data.posture``, which moves no tool, turn each elbow at its rate, no joint beyond the posture's speed.

    The scratch's ``free`` is the rows' part in the tools' nullspace.
    """
    member, scratch, posture, fastest = model.tools.member, data.swivel, data.posture, model.posture.speed
    for i in range(member.shape[0]):
        if scratch.share[i] == 0.0:
            continue
        now = 0.0
        per_unit = _DAMPING
        for j in range(posture.shape[0]):
            if member[i, j] == 1.0:
                now += scratch.row[j] * posture[j]
                per_unit += scratch.row[j] * scratch.free[j]
        largest = 0.0
        for j in range(posture.shape[0]):
            if member[i, j] == 1.0:
                posture[j] += scratch.share[i] * (scratch.rate[i] - now) / per_unit * scratch.free[j]
                largest = max(largest, abs(posture[j]))
        if largest > fastest:
            for j in range(posture.shape[0]):
                if member[i, j] == 1.0:
                    posture[j] *= fastest / largest
