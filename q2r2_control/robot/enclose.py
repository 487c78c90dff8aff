"""Enclose collision shapes by the shapes that the distance kernels can measure.

Capsules and spheres stay as they are, and so do boxes that are fixed in the world. Every other shape is enclosed. A
moving box becomes a capsule as well, because the distance of two boxes has no short closed form.

A mesh becomes a capsule around its vertices. The capsule is convex, and so it also encloses the triangles. For safety
it must enclose every vertex, which the construction guarantees for any axis and any centre.

Several capsules enclose a mesh together: parallel planes cut it into slabs. The part of a triangle in a slab has its
corners at vertices and where edges cross the planes of the slab. The capsule of the slab encloses all of these corners.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from itertools import combinations, pairwise, product

import coal
import numpy as np
import numpy.typing as npt
import pinocchio as pin
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial import ConvexHull, QhullError

from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.pairs import link_of
from q2r2_control.types import Array

Capsule = tuple[float, Array, Array]  # The radius and both ends of the segment (3,) [m].

# One micrometre is added to every enclosing radius, because rounding may make it smaller.
_ROUNDING = 1e-6
_SLABS = 12  # Number of slabs of equal height into which a mesh is cut. Each capsule encloses neighbouring slabs.


def enclose_shapes(geometry: pin.GeometryModel, capsules: Mapping[str, int] | None = None) -> None:
    """Replace in place every shape that is not a capsule, a sphere or a box fixed in the world; names and pairs stay.

    The first capsule of a mesh has the name of the mesh. The others come after all shapes, as further shapes of their
    link.

    Args:
        geometry: The geometry model.
        capsules: For some links, the greatest number of capsules for each of their meshes. The value 1 is also allowed
            for links with other shapes.

    Raises:
        RobotError: If a shape has no extent or no bounds.
        ConfigError: If a link in ``capsules`` has no shape, or if it has no mesh and gets more than one capsule.
    """
    capsules = capsules or {}
    numbers = Counter(link_of(item.name) for item in geometry.geometryObjects)
    meshes = {link_of(one.name) for one in geometry.geometryObjects if isinstance(one.geometry, coal.BVHModelBase)}
    for link, count in capsules.items():
        if link not in numbers:
            allowed = ", ".join(sorted(numbers)) or "none in this cell"
            raise ConfigError(f"capsules.{link!s:.60}: no link with a shape; allowed: {allowed}")
        if count > 1 and link not in meshes:
            raise ConfigError(f"capsules.{link} = {count}: this link has no mesh; allowed: 1")
    more = []
    for item in geometry.geometryObjects:
        fixed_box = isinstance(item.geometry, coal.Box) and item.parentJoint == 0
        if fixed_box or isinstance(item.geometry, coal.Capsule | coal.Sphere):
            continue
        if isinstance(shape := item.geometry, coal.Cylinder):
            radius, half_length = float(shape.radius), float(shape.halfLength)
            item.geometry = _around_cylinder(radius, half_length, box_allowed=item.parentJoint == 0)
        else:
            link, drawn = link_of(item.name), item.placement.copy()
            first, *others = capsules_around(shape, item.name, capsules.get(link, 1))
            item.geometry, placement = capsule_between(*first)
            item.placement = drawn * placement
            for other in others:
                part, placement = capsule_between(*other)
                name = f"{link}_{numbers[link]}"
                more.append(pin.GeometryObject(name, item.parentJoint, item.parentFrame, drawn * placement, part))
                numbers[link] += 1
        item.meshPath = ""
        item.meshScale = np.ones(3)
    for item in more:
        geometry.addGeometryObject(item)


def capsules_around(shape: coal.CollisionGeometry, name: str, count: int) -> list[Capsule]:
    """Return capsules that together enclose a shape, in its frame: at most ``count`` for a mesh, one for others.

    Raises:
        RobotError: If the shape ``name`` has no bounds.
    """
    vertices = _vertices(shape, name)
    if count == 1 or not isinstance(shape, coal.BVHModelBase):
        return [enclosing_capsule(vertices)]
    triangles = np.array(
        [[one[0], one[1], one[2]] for one in map(shape.tri_indices, range(shape.num_tris))], dtype=np.int64
    )
    return list(_cached_capsules(vertices.tobytes(), triangles.tobytes(), count))


def enclosing_capsule(points: Array) -> Capsule:
    """Return a small capsule around ``points`` (n, 3): the radius and both ends of the segment (3,).

    The search starts from the principal axes. It minimises the volume over the direction of the axis (two angles), the
    position of the axis (two offsets), and the radius. Let a point have the height t along the axis, and the distance
    rho from it. The point is inside a capsule of radius r if the segment has a height within sqrt(r^2 - rho^2) of t.
    """
    return _cached_capsule(np.array(points, dtype=float, order="C").tobytes())


@lru_cache(maxsize=256)
def _cached_capsule(found: bytes) -> Capsule:
    """Compute a capsule once for all equal meshes, because both arms usually have the same meshes.

    ``found`` are the bytes of the points (n, 3).
    """
    points = _corners(np.frombuffer(found).reshape(-1, 3))
    centre = points.mean(axis=0)
    scale = max(float(np.abs(points - centre).max()), 1e-9)
    # Full matrices are needed only if there are fewer points than axes. For n points they are n x n.
    axes = np.linalg.svd(points - centre, full_matrices=len(points) < 3)[2]
    frame, view = _best_view(points - centre, axes, scale)
    options = {"maxiter": 600, "xatol": 1e-4, "fatol": 1e-5}
    start = _start(view)
    result = minimize(lambda x: _volume(*_fit(view, x)), start, method="Nelder-Mead", options=options)
    radius, ends = _fit(view, result.x)
    start, end = ends * scale @ frame + centre
    return radius * scale + _ROUNDING, start, end


@lru_cache(maxsize=64)
def _cached_capsules(points: bytes, corners: bytes, count: int) -> tuple[Capsule, ...]:
    """Return at most ``count`` capsules, each around neighbouring slabs of a mesh.

    The slabs lie along the principal axis for which the capsules have the least volume.
    """
    vertices = np.frombuffer(points).reshape(-1, 3)
    triangles = np.frombuffer(corners, dtype=np.int64).reshape(-1, 3)
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    best: tuple[float, list[Array]] = (np.inf, [])
    for axis in np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]:
        slabs = _slabs(vertices, edges, axis)
        parts = {cut: _corners(np.concatenate(slabs[slice(*cut)])) for cut in combinations(range(_SLABS + 1), 2)}
        volumes = {cut: _first_volume(part) for cut, part in parts.items()}
        for inner in combinations(range(1, _SLABS), count - 1):
            cuts = list(pairwise((0, *inner, _SLABS)))
            if (volume := sum(map(volumes.__getitem__, cuts))) < best[0]:
                best = volume, [parts[cut] for cut in cuts if len(parts[cut])]
    return tuple(map(enclosing_capsule, best[1]))


def _slabs(vertices: Array, edges: npt.NDArray[np.int64], axis: Array) -> list[Array]:
    """Return, for each slab across ``axis`` (3,), the corners (n, 3) of all triangles' parts in it.

    ``edges`` (m, 2) are the edges of the triangles.
    """
    height = vertices @ axis
    planes = np.linspace(height.min(), height.max(), _SLABS + 1)
    below, above = height[edges].T
    crossings = []
    for plane in planes:
        crossing = (below - plane) * (above - plane) < 0
        start, end = vertices[edges[crossing]].transpose(1, 0, 2)
        share = (plane - below[crossing]) / (above - below)[crossing]
        crossings.append(start + share[:, None] * (end - start))
    return [
        _corners(np.concatenate([vertices[(height >= low) & (height <= high)], *on_planes]))
        for (low, high), on_planes in zip(pairwise(planes), pairwise(crossings), strict=True)
    ]


def _corners(points: Array) -> Array:
    """Return the corners of the convex hull of ``points`` (n, 3)."""
    with suppress(QhullError, ValueError):  # Qhull fails if the points lie in a plane or are too few.
        points = points[ConvexHull(points).vertices]
    return points


def _best_view(points: Array, axes: Array, scale: float = 1.0) -> tuple[Array, Array]:
    """Return the best order of ``axes`` (3, 3), and the ``points`` (n, 3) along these axes, divided by ``scale``.

    The capsule at which the search begins lies along the last axis. In the best order, this capsule is the smallest.
    """
    frames = [axes[[index - 2, index - 1, index]] for index in range(3)]
    views = [points @ frame.T / scale for frame in frames]
    best = int(np.argmin([_volume(*_fit(view, _start(view))) for view in views]))
    return frames[best], views[best]


def _first_volume(points: Array) -> float:
    """Return the volume of the capsule around ``points`` (n, 3) at which the search begins; 0 without points."""
    if not len(points):
        return 0.0
    offsets = points - points.mean(axis=0)
    view = _best_view(offsets, np.linalg.eigh(offsets.T @ offsets)[1].T)[1]
    return _volume(*_fit(view, _start(view)))


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
    """Return the radius of a capsule around the points ``local`` (n, 3), and the ends of its segment (2, 3).

    The axis has the direction (x0, x1, 1), and goes through the point (x2, x3, 0). The radius is the greatest distance
    of a point from the axis, times 1 + abs(x4).
    """
    direction = np.array([x[0], x[1], 1.0])
    direction /= np.linalg.norm(direction)
    place = np.array([x[2], x[3], 0.0])
    offset = local - place
    height = offset @ direction
    across = np.linalg.norm(offset - np.outer(height, direction), axis=1)
    radius = float(across.max()) * (1 + abs(x[4]))
    reach = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    top, bottom = float((height - reach).max()), float((height + reach).min())
    if top < bottom:  # A sphere with its centre between these heights encloses every point.
        top = bottom = (top + bottom) / 2
    return radius, place + np.outer([bottom, top], direction)


def _volume(radius: float, ends: Array) -> float:
    return float(np.pi * radius**2 * (np.linalg.norm(ends[1] - ends[0]) + 4 / 3 * radius))


def _around_cylinder(radius: float, half_length: float, box_allowed: bool) -> coal.CollisionGeometry:
    """Return the smallest capsule on the cylinder's axis, or a box around the cylinder if that is allowed and smaller.

    The box is smaller for flat cylinders, such as a round table top.
    """

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
    """Return Coal's capsule from ``start`` to ``end``, and the pose of its middle, whose z is along the capsule."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).matrix()
    return coal.Capsule(radius, length), pin.SE3(rotation, (start + end) / 2)
