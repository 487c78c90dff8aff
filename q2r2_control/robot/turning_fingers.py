"""The space that a turning finger sweeps while its gripper's opening is in an interval: one capsule for each shape as
drawn.

**Claim.** The capsule of an interval encloses the shape at every opening in that interval, not only at samples.

*Proof.* A shape is the hull of two balls, so it is enough to hold the balls' centres with the balls' radius. Where a
driven joint goes from one position to another in m equal steps, with the joints that mimic it, a centre x is a function
of that one parameter. In a step in which these joints move by w_i, linear interpolation between both ends of the step
is off by at most an eighth of the greatest second derivative,

    1/8 sum_ik w_i w_k r_(the outer one of i and k),

since the second derivative by two turning joints is a product of rotations about both axes with the lever of the outer
one. r bounds how far x is from a joint's axis. A slide has r = 1, as the outer one of two, and 0 as the inner one or
twice. With several driven joints in one chain, interpolation is by each of them in turn. Each time it takes means of
the values before. The errors add up, and derivatives by two different driven joints do not count. Interpolated points
lie in the hull of the samples. A capsule is convex: one that holds each sample with the shape's radius and that
remainder holds all. For any segment the radius that does this is the farthest sample's distance from it, plus both. []

The choice of the segment decides on size only. Of some along the shape and some along its way, the one of the least
mean width is taken. Capsules of two intervals are not nested even if the intervals are: one for less may stick out of
one for more. A narrower interval has to be proven as if a body grew (:func:`sticks_out`). The wider interval's capsule
stays valid as long as the opening is in it, so a narrower one may always be refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval

_REMAINDER = 5e-5  # that steps are made short enough for [m]
_MOST_SAMPLES = 512  # of all driven joints of a chain together; with fewer than it takes the remainder is larger
_ROUNDING = 1e-9  # [m]
# By which share of the least radius less a segment's ends are pulled in: a thicker capsule with a flatter end.
_PULLED_IN = np.array([0.0, 0.58, 1.2])


@dataclass(frozen=True, slots=True)
class FingerJoint:
    """A joint that moves a shape, as that was drawn, in the frame of the arm's link that carries the hand.

    Positions of the joints of one driver are linear in the driver's, also beyond the stroke.
    """

    slides: bool
    axis: Array  # (3,) unit vector
    point: Array  # (3,) on the axis [m]
    home: float  # position where the shape was drawn [m or rad]
    closed: float  # positions of the closed and of the open gripper
    open: float
    before: float  # positions at the ends of the travel, before the closed and beyond the open gripper
    beyond: float
    driver: str  # the joint that it mimics, or itself

    def travel(self, interval: Interval) -> tuple[float, float]:
        """Positions at both ends of ``interval``; an end at 0 or 1 is that of the travel, beyond the gripper's."""
        first = self.before if interval[0] <= 0.0 else self.closed + interval[0] * (self.open - self.closed)
        last = self.beyond if interval[1] >= 1.0 else self.closed + interval[1] * (self.open - self.closed)
        return first, last


class Capsules(NamedTuple):
    """One for each of some bodies, in the frame of the link that carries the hand."""

    start: Array  # (b, 3) [m]
    end: Array  # (b, 3)
    radius: Array  # (b,)


@dataclass(frozen=True)
class TurningBody:
    """A shape of a finger of which some joint turns."""

    arm: str
    name: str  # of the geometry
    ends: Array  # (2, 3) of its segment as drawn [m]
    radius: float  # as drawn [m], which no capsule around it is below
    joints: tuple[FingerJoint, ...]  # from the hand outwards

    def curvatures(self) -> Array:
        """Return a bound (j, j) [m] on the second derivatives of a shape's points by the positions of two joints.

        It is 0 if the two joints have different drivers.
        """
        bounds = np.zeros((len(self.joints), len(self.joints)))
        farthest, beyond = 0.0, self.ends  # from a point on the joint's axis to the ends, at most [m]
        for k, outer in reversed(list(enumerate(self.joints))):
            farthest += float(np.linalg.norm(beyond - outer.point, axis=1).max())
            if outer.slides:
                farthest += max(abs(position - outer.home) for position in (outer.before, outer.beyond))
            for i, inner in enumerate(self.joints[: k + 1]):
                if inner.driver == outer.driver and not inner.slides:
                    bounds[i, k] = bounds[k, i] = 1.0 if outer.slides else farthest
            beyond = outer.point[None]
        return bounds

    @cached_property
    def extent(self) -> float:
        """How far the segment of any interval's capsule is from the carrying link's origin, at most [m]."""
        return float(TurningSweeps((self,)).extent[0])

    @cached_property
    def way(self) -> float:
        """How far an end is from where it was when the closed gripper has opened, at most [m]."""
        closed, opened = map(TurningSweeps((self,)).ends_at, (0.0, 1.0))
        return float(np.linalg.norm(opened[0] - closed[0], axis=1).max())

    def capsule(self, interval: Interval) -> tuple[Array, Array, float]:
        """Both ends (3,) of the segment and the radius [m] of the capsule around the shape in ``interval``."""
        capsules = TurningSweeps((self,)).capsules(interval)
        return capsules.start[0], capsules.end[0], float(capsules.radius[0])


class TurningSweeps:
    """Capsules of several bodies at once, in arrays: a gripper asks for all of its own in mid-motion."""

    def __init__(self, bodies: Sequence[TurningBody]) -> None:
        count, depth = len(bodies), max(len(body.joints) for body in bodies)
        self._ends, self._radius = np.array([body.ends for body in bodies]), np.array([b.radius for b in bodies])
        self._point, self._axis = np.zeros((depth, count, 3)), np.zeros((depth, count, 3))
        self._home, self._slides = np.zeros((depth, count)), np.ones((depth, count))
        self._stroke, self._travel = np.zeros((2, depth, count)), np.zeros((2, depth, count))
        self._curvature = np.zeros((count, depth, depth))
        self._driver = np.zeros((depth, count), dtype=np.int64)
        drivers = 1
        for b, body in enumerate(bodies):
            names = list(dict.fromkeys(joint.driver for joint in body.joints))
            drivers, own = max(drivers, len(names)), len(body.joints)
            self._curvature[b, :own, :own] = body.curvatures()
            for j, joint in enumerate(body.joints):
                self._point[j, b], self._axis[j, b], self._home[j, b] = joint.point, joint.axis, joint.home
                self._slides[j, b], self._driver[j, b] = joint.slides, names.index(joint.driver)
                self._stroke[:, j, b], self._travel[:, j, b] = (joint.closed, joint.open), (joint.before, joint.beyond)
        x, y, z = self._axis[..., 0], self._axis[..., 1], self._axis[..., 2]
        zero = np.zeros_like(x)
        self._cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(depth, 1, count, 3, 3)
        self._along = (self._axis[..., :, None] * self._axis[..., None, :])[:, None]
        self._across = np.eye(3) - self._along
        self._drivers, self._most_steps = drivers, max(int(_MOST_SAMPLES ** (1.0 / drivers)) - 1, 1)
        points, remainder = self._samples(ALL_OF_THE_WAY)
        self.extent: Array = np.linalg.norm(points, axis=2).max(axis=1) + remainder  # (b,) see TurningBody.extent

    def capsules(self, interval: Interval) -> Capsules:
        """The capsules that enclose the shapes at every opening in ``interval``."""
        points, remainder = self._samples(interval)
        half = points.shape[1] // 2
        first, second = points[:, :half], points[:, half:]
        middles = 0.5 * (first + second)
        way, middle = 0.5 * (middles[:, -1] - middles[:, 0]), middles.mean(axis=1)
        starts = np.stack([first.mean(axis=1), middle - way], axis=1)  # (b, 2, 3): along the shape, along its way
        ends = np.stack([second.mean(axis=1), middle + way], axis=1)
        pull = _PULLED_IN * _farthest(points, starts, ends)[..., None]
        length = np.linalg.norm(ends - starts, axis=2)[..., None]
        share = np.minimum(pull / np.maximum(length, 1e-12), 0.5)[..., None]  # (b, 2, 3, 1)
        between = (ends - starts)[:, :, None]
        starts, ends = starts[:, :, None] + share * between, ends[:, :, None] - share * between
        starts, ends = starts.reshape(len(points), -1, 3), ends.reshape(len(points), -1, 3)
        radius = _farthest(points, starts, ends) + (self._radius + remainder + _ROUNDING)[:, None]
        width = radius + 0.25 * np.linalg.norm(ends - starts, axis=2)
        # Bounds of how fast bodies move are made of the extent; segments along the shape are in the samples' hull.
        reached = np.maximum(np.linalg.norm(starts, axis=2), np.linalg.norm(ends, axis=2))
        reached[:, : len(_PULLED_IN)] = 0.0
        best = np.argmin(np.where(reached <= self.extent[:, None], width, np.inf), axis=1)
        rows = np.arange(len(points))
        return Capsules(starts[rows, best], ends[rows, best], radius[rows, best])

    def ends_at(self, opening: float) -> Array:
        """Return both ends of the segment of each of b shapes (b, 2, 3) [m], with all driven joints at ``opening``."""
        closed, opened = self._stroke
        points = self._ends[None]
        for j in reversed(range(len(self._home))):
            points = self._moved(j, (closed[j] + opening * (opened[j] - closed[j]) - self._home[j])[None], points)
        return points[0]

    def _samples(self, interval: Interval) -> tuple[Array, Array]:
        """Both ends of each segment (b, 2 s, 3) at samples of ``interval``, the first ends before the second ones.

        And by how much what is between may be off (b,) [m].
        """
        closed, opened = self._stroke
        # An end of the interval at 0 or 1 is that of the joints' travel, which may be beyond the gripper's.
        first = self._travel[0] if interval[0] <= 0.0 else closed + interval[0] * (opened - closed)
        last = self._travel[1] if interval[1] >= 1.0 else closed + interval[1] * (opened - closed)
        travel, count = np.abs(last - first), len(self._ends)
        in_one_step = 0.125 * np.einsum("ib,bik,kb->b", travel, self._curvature, travel)
        wanted = math.sqrt(float(in_one_step.max()) / _REMAINDER)
        steps = min(max(math.ceil(wanted), 1), self._most_steps)
        grid = np.meshgrid(*[np.linspace(0.0, 1.0, steps + 1)] * self._drivers, indexing="ij")
        shares = np.stack([axis.ravel() for axis in grid], axis=-1)  # (s, drivers)
        points = np.broadcast_to(self._ends, (len(shares), count, 2, 3))
        for j in reversed(range(len(self._home))):
            share = shares[:, self._driver[j]]  # (s, b)
            # Exact at both ends of the travel.
            moved = (1.0 - share) * first[j] + share * last[j] - self._home[j]
            points = self._moved(j, moved, points)
        ends = points.transpose(1, 2, 0, 3).reshape(count, -1, 3)
        return ends, in_one_step / steps**2

    def _moved(self, j: int, by: Array, points: Array) -> Array:
        """Points (s, b, 2, 3) as joint ``j`` of each body moves them ``by`` (s, b) [m or rad]."""
        slide = (by * self._slides[j])[..., None] * self._axis[j]
        angle = (by * (1.0 - self._slides[j]))[..., None, None]
        rotation = self._along[j] + np.cos(angle) * self._across[j] + np.sin(angle) * self._cross[j]
        centre = self._point[j][:, None]
        moved: Array = (points - centre) @ rotation.swapaxes(-1, -2) + centre + slide[:, :, None]
        return moved


def sticks_out(inner: Capsules, outer: Capsules) -> Array:
    """Of each capsule of ``inner`` (b,), whether it is not within that of ``outer``.

    A capsule is the hull of the balls at its ends, so it is within another one exactly when these are.
    """
    points = np.stack([inner.start, inner.end], axis=1)
    farthest = _farthest(points, outer.start[:, None], outer.end[:, None])[:, 0]
    return np.asarray(farthest + inner.radius > outer.radius)


def _farthest(points: Array, start: Array, end: Array) -> Array:
    """How far the farthest of ``points`` (b, n, 3) is from each segment, ``start`` and ``end`` (b, k, 3): (b, k)."""
    along = end - start
    square = np.maximum((along * along).sum(axis=2), 1e-30)
    offset = points[:, None] - start[:, :, None]  # (b, k, n, 3)
    share = np.clip((offset @ along[..., None])[..., 0] / square[..., None], 0.0, 1.0)
    apart = offset - share[..., None] * along[:, :, None]
    return np.sqrt(np.einsum("bknc,bknc->bkn", apart, apart).max(axis=2))
