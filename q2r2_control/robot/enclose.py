"""Collision shapes as the distance kernels want them.

Capsules, spheres and boxes fixed in the world stay; everything else is enclosed. A box that moves becomes a capsule
too: a pair of two boxes has no short closed form.

A mesh or convex becomes a capsule around its vertices, hence around its triangles, since a capsule is convex. Safety
rests on its enclosing every vertex only, which its construction gives for any axis and any centre.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from itertools import product

import coal
import numpy as np
import pinocchio as pin
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial import ConvexHull, QhullError

from q2r2_control.errors import RobotError
from q2r2_control.types import Array

# Rounding may take something away, which is given back: 1 micrometre on every enclosing radius.
_ROUNDING = 1e-6


def enclose_shapes(geometry: pin.GeometryModel) -> None:
    """Replace in place every shape that is not a capsule, a sphere or a box fixed in the world; names and pairs stay.

    Raises :class:`RobotError` for a shape without extent or without bounds.
    """
    for item in geometry.geometryObjects:
        fixed_box = isinstance(item.geometry, coal.Box) and item.parentJoint == 0
        if fixed_box or isinstance(item.geometry, coal.Capsule | coal.Sphere):
            continue
        if isinstance(shape := item.geometry, coal.Cylinder):
            radius, half_length = float(shape.radius), float(shape.halfLength)
            item.geometry = _around_cylinder(radius, half_length, box_allowed=item.parentJoint == 0)
        else:
            item.geometry, placement = capsule_between(*_cached_capsule(_vertices(shape, item.name).tobytes()))
            item.placement = item.placement * placement
        item.meshPath = ""
        item.meshScale = np.ones(3)


def enclosing_capsule(points: Array) -> tuple[float, Array, Array]:
    """A small capsule around ``points`` (n, 3): radius and the segment's two ends (3,), same unit and frame.

    Starts from the principal axes and minimises the volume over the axis (two angles), its place (two offsets) and the
    radius beyond the least one. For an axis with radius r, a point at height t and distance rho from it is inside when
    the segment covers a height within sqrt(r^2 - rho^2) of t.
    """
    points = np.asarray(points, dtype=float)
    with suppress(QhullError, ValueError):  # of points in a plane, or too few
        points = points[ConvexHull(points).vertices]
    centre = points.mean(axis=0)
    scale = max(float(np.abs(points - centre).max()), 1e-9)
    axes = np.linalg.svd(points - centre, full_matrices=True)[2]
    frames = [axes[[index - 2, index - 1, index]] for index in range(3)]  # rows: two across, one along
    views = [(points - centre) @ frame.T / scale for frame in frames]
    best = int(np.argmin([_volume(*_fit(view, _start(view))) for view in views]))
    options = {"maxiter": 600, "xatol": 1e-4, "fatol": 1e-5}
    start = _start(views[best])
    result = minimize(lambda x: _volume(*_fit(views[best], x)), start, method="Nelder-Mead", options=options)
    radius, ends = _fit(views[best], result.x)
    start, end = ends * scale @ frames[best] + centre
    return radius * scale + _ROUNDING, start, end


@lru_cache(maxsize=64)
def _cached_capsule(points: bytes) -> tuple[float, Array, Array]:
    """Both arms of a cell usually share their meshes."""
    return enclosing_capsule(np.frombuffer(points).reshape(-1, 3))


def _vertices(shape: coal.CollisionGeometry, name: str) -> Array:
    if isinstance(shape, coal.Box):
        vertices = np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide
    elif isinstance(shape, coal.BVHModelBase):
        vertices = np.array(shape.vertices())
    elif isinstance(shape, coal.ConvexBase):
        vertices = np.array(shape.points())
    else:
        raise RobotError(f"collision shape {name} is a {type(shape).__name__}; allowed: bounded primitives and meshes")
    if vertices.size == 0 or not np.isfinite(vertices).all():
        raise RobotError(f"collision mesh {name} has no vertices, or some that are not finite")
    return vertices.reshape(-1, 3)


def _start(local: Array) -> Array:
    middle = (local[:, :2].max(axis=0) + local[:, :2].min(axis=0)) / 2
    return np.array([0.0, 0.0, middle[0], middle[1], 0.05])


def _fit(local: Array, x: Array) -> tuple[float, Array]:
    """Radius and segment ends (2, 3) of the capsule around ``local`` whose axis ``x`` tilts and shifts from z."""
    direction = np.array([x[0], x[1], 1.0])
    direction /= np.linalg.norm(direction)
    place = np.array([x[2], x[3], 0.0])
    offset = local - place
    height = offset @ direction
    across = np.linalg.norm(offset - np.outer(height, direction), axis=1)
    radius = float(across.max()) * (1 + abs(x[4]))
    reach = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    top, bottom = float((height - reach).max()), float((height + reach).min())
    if top < bottom:  # one sphere covers every point: any height between the two will do
        top = bottom = (top + bottom) / 2
    return radius, place + np.outer([bottom, top], direction)


def _volume(radius: float, ends: Array) -> float:
    return float(np.pi * radius**2 * (np.linalg.norm(ends[1] - ends[0]) + 4 / 3 * radius))


def _around_cylinder(radius: float, half_length: float, box_allowed: bool) -> coal.CollisionGeometry:
    """The smallest coaxial capsule, or the box where that is allowed and smaller, as for a round table top."""

    def half_segment(capsule_radius: float) -> float:
        return max(half_length - float(np.sqrt(max(capsule_radius**2 - radius**2, 0.0))), 0.0)

    def volume(capsule_radius: float) -> float:
        return float(np.pi * capsule_radius**2 * (2 * half_segment(capsule_radius) + 4 / 3 * capsule_radius))

    found = minimize_scalar(volume, bounds=(radius, float(np.hypot(radius, half_length))), method="bounded")
    best = float(found.x)
    if box_allowed and 8 * radius**2 * half_length < volume(best):
        return coal.Box(2 * radius, 2 * radius, 2 * half_length)
    return coal.Capsule(best + _ROUNDING, 2 * half_segment(best))


def capsule_between(radius: float, start: Array, end: Array) -> tuple[coal.CollisionGeometry, pin.SE3]:
    """A capsule from ``start`` to ``end``; Coal's lies along z about its middle and takes the segment's length."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    return coal.Capsule(radius, length), pin.SE3(rotation, (start + end) / 2)
