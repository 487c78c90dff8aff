"""Compute the space that a turning finger sweeps while its gripper's opening is in an interval.

Each shape of the finger gets one capsule.

**Claim.** The capsule of an interval encloses the shape at every opening in that interval, not only at samples.

*Proof.* A shape is the hull of two balls. It is therefore enough to enclose the centres of the balls, and to add the
radius of the balls. Let a driven joint go from one position to another in m equal steps, together with the joints that
mimic it. Then a centre x is a function of this one parameter. Let these joints move by w_i in a step. Linear
interpolation between both ends of the step has an error of at most an eighth of the greatest second derivative,

    1/8 sum_ik w_i w_k r_(the outer one of i and k),

because the second derivative by two turning joints is a product of rotations about both axes with the lever of the
outer joint. Here r bounds the distance of x from the axis of a joint. If the outer joint slides and the inner joint
turns, r = 1. If the inner joint slides, or if i and k are the same sliding joint, r = 0. Several driven joints in one
chain are interpolated one after the other. Each interpolation takes means of the values of the interpolation before it.
The errors therefore add up, and derivatives by two different driven joints do not count. Interpolated points lie in the
hull of the samples. A capsule is convex. If it encloses each sample with the shape's radius and that remainder, it
encloses all points. For any segment, this radius is the distance of the farthest sample from the segment, plus the
shape's radius and the remainder. []

The choice of the segment affects only the size of the capsule. Some candidates lie along the shape and some along the
path of its middle. The candidate with the least mean width is taken. Capsules of nested intervals are not nested: the
capsule of the narrower interval may stick out of the capsule of the wider interval. A change to a narrower interval has
to be proven safe as if a body grew (:func:`sticks_out`). The capsule of the wider interval stays valid as long as the
opening is in that interval. A narrower interval may therefore always be refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval

_REMAINDER = 5e-5  # The wanted error of the interpolation. The steps are made short enough for it [m].
# Greatest number of samples of all driven joints of a chain together. If more samples were needed for the wanted error,
# the error is greater.
_MOST_SAMPLES = 512
_ROUNDING = 1e-9  # Addition to radii for the rounding of numbers [m].
# Each candidate is tried in three lengths. Both of its ends are moved inwards by these multiples of its capsule's
# radius (without the shape's own radius). A capsule with a shorter segment is thicker.
_PULLED_IN = np.array([0.0, 0.58, 1.2])


@dataclass(frozen=True, slots=True)
class FingerJoint:
    """A joint that moves a shape, in the frame of the arm's link to which the gripper is fixed.

    The shape was drawn at the position ``home``. The positions of all joints with one driver are linear functions of
    the driver's position, also beyond the stroke. All positions are in [m or rad].
    """

    slides: bool
    axis: Array  # Unit vector (3,).
    point: Array  # A point on the axis (3,) [m].
    home: float  # The position at which the shape was drawn.
    closed: float  # The position with the gripper closed.
    open: float  # The position with the gripper open.
    before: float  # The end of the travel before the closed position.
    beyond: float  # The end of the travel beyond the open position.
    driver: str  # The joint that it mimics, or its own name.

    def travel(self, interval: Interval) -> tuple[float, float]:
        """Return the positions at both ends of ``interval``.

        The position for 0 or 1 is the end of the joint's travel, which may lie beyond the gripper's stroke.
        """
        first = self.before if interval[0] <= 0.0 else self.closed + interval[0] * (self.open - self.closed)
        last = self.beyond if interval[1] >= 1.0 else self.closed + interval[1] * (self.open - self.closed)
        return first, last


class Capsules(NamedTuple):
    """One capsule for each of b bodies, in the frame of the link to which the gripper is fixed."""

    start: Array  # (b, 3) [m]
    end: Array  # (b, 3) [m]
    radius: Array  # (b,) [m]


@dataclass(frozen=True)
class TurningBody:
    """A shape of a finger that has at least one turning joint."""

    arm: str
    name: str  # Name of the geometry object.
    ends: Array  # Both ends of its segment as drawn (2, 3) [m].
    radius: float  # Radius as drawn [m]. A capsule around it has at least this radius.
    joints: tuple[FingerJoint, ...]  # The joints that move it, from the base of the gripper outwards.

    def curvatures(self) -> Array:
        """Return a bound (j, j) [m] on the second derivatives of a shape's points by the positions of two joints.

        It is 0 if the two joints have different drivers.
        """
        bounds = np.zeros((len(self.joints), len(self.joints)))
        farthest, beyond = 0.0, self.ends  # ``farthest`` bounds the distance of the ends from the joint's axis [m].
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
        """The greatest distance [m] of any interval's capsule, without its radius, from the frame's origin."""
        return float(TurningSweeps((self,)).extent[0])

    @cached_property
    def way(self) -> float:
        """The greatest distance between the closed and the open position of an end of the segment [m]."""
        closed, opened = map(TurningSweeps((self,)).ends_at, (0.0, 1.0))
        return float(np.linalg.norm(opened[0] - closed[0], axis=1).max())

    def capsule(self, interval: Interval) -> tuple[Array, Array, float]:
        """Return both ends of the segment (3,) and the radius of the capsule around the shape in ``interval`` [m]."""
        capsules = TurningSweeps((self,)).capsules(interval)
        return capsules.start[0], capsules.end[0], float(capsules.radius[0])


class TurningSweeps:
    """Computes the capsules of several bodies together in arrays. A moving gripper needs all of its capsules."""

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
        # TurningBody.extent of each body (b,) [m].
        self.extent: Array = np.linalg.norm(points, axis=2).max(axis=1) + remainder

    def capsules(self, interval: Interval) -> Capsules:
        """Return the capsules that enclose the shapes at every opening in ``interval``."""
        points, remainder = self._samples(interval)
        half = points.shape[1] // 2
        first, second = points[:, :half], points[:, half:]
        middles = 0.5 * (first + second)
        way, middle = 0.5 * (middles[:, -1] - middles[:, 0]), middles.mean(axis=1)
        # The candidates (b, 2, 3): the first segment lies along the shape, the second one along the path of its middle.
        starts = np.stack([first.mean(axis=1), middle - way], axis=1)
        ends = np.stack([second.mean(axis=1), middle + way], axis=1)
        pull = _PULLED_IN * _farthest(points, starts, ends)[..., None]
        length = np.linalg.norm(ends - starts, axis=2)[..., None]
        share = np.minimum(pull / np.maximum(length, 1e-12), 0.5)[..., None]  # (b, 2, 3, 1)
        between = (ends - starts)[:, :, None]
        starts, ends = starts[:, :, None] + share * between, ends[:, :, None] - share * between
        starts, ends = starts.reshape(len(points), -1, 3), ends.reshape(len(points), -1, 3)
        radius = _farthest(points, starts, ends) + (self._radius + remainder + _ROUNDING)[:, None]
        width = radius + 0.25 * np.linalg.norm(ends - starts, axis=2)
        # The bounds of the bodies' speeds rely on the extent, and so no segment may reach beyond it. Segments along the
        # shape never do, because they lie in the hull of the samples.
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
        """Return the ends of each segment at samples of ``interval`` (b, 2 s, 3) [m], and the remainders (b,) [m].

        All first ends come before all second ends. A remainder bounds the error of the interpolation between samples.
        """
        closed, opened = self._stroke
        # An end of the interval at 0 or 1 is the end of the joints' travel, which may lie beyond the gripper's stroke.
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
            # This form is exact at both ends of the travel.
            moved = (1.0 - share) * first[j] + share * last[j] - self._home[j]
            points = self._moved(j, moved, points)
        ends = points.transpose(1, 2, 0, 3).reshape(count, -1, 3)
        return ends, in_one_step / steps**2

    def _moved(self, j: int, by: Array, points: Array) -> Array:
        """Return points (s, b, 2, 3) [m] after joint ``j`` of each body has moved them ``by`` (s, b) [m or rad]."""
        slide = (by * self._slides[j])[..., None] * self._axis[j]
        angle = (by * (1.0 - self._slides[j]))[..., None, None]
        rotation = self._along[j] + np.cos(angle) * self._across[j] + np.sin(angle) * self._cross[j]
        centre = self._point[j][:, None]
        moved: Array = (points - centre) @ rotation.swapaxes(-1, -2) + centre + slide[:, :, None]
        return moved


def sticks_out(inner: Capsules, outer: Capsules) -> Array:
    """Return for each capsule of ``inner`` whether it is not within the capsule of ``outer`` (b,).

    A capsule is the hull of the balls at its ends. It is within another capsule exactly if both of its balls are.
    """
    points = np.stack([inner.start, inner.end], axis=1)
    farthest = _farthest(points, outer.start[:, None], outer.end[:, None])[:, 0]
    return np.asarray(farthest + inner.radius > outer.radius)


def _farthest(points: Array, start: Array, end: Array) -> Array:
    """Return the distance of the farthest of ``points`` (b, n, 3) from each segment (b, k) [m].

    ``start`` and ``end`` are the ends of the segments (b, k, 3) [m].
    """
    along = end - start
    square = np.maximum((along * along).sum(axis=2), 1e-30)
    offset = points[:, None] - start[:, :, None]  # (b, k, n, 3)
    share = np.clip((offset @ along[..., None])[..., 0] / square[..., None], 0.0, 1.0)
    apart = offset - share[..., None] * along[:, :, None]
    return np.sqrt(np.einsum("bknc,bknc->bkn", apart, apart).max(axis=2))
