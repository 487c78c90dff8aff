"""Compute the signed distances of monitored pairs, exact and smooth, and the rows that are their gradients (compiled).

For the closest points p1, p2 and the unit normal n from the first body to the second, the distance changes with d' = n'
(J_p2 - J_p1) v. Only joints that move one body relative to the other appear in this equation.

**Smooth distances** have a gradient that never jumps. Forces that follow the gradient need this. The closest points of
two parallel segments, or of a segment along a box's face, jump from end to end as the bodies tilt. Here a small cost
pulls the parameters s, t in [0, 1] of the closest points to the middles of the segments,

    D^2 = min |a(s) - b(t)|^2 + e ((s - 1/2)^2 + (t - 1/2)^2).

This makes the closest points unique, and continuous in the posture. By the envelope theorem dD = (b - a)' d(b - a) / D
at these points. If a pair's row is computed with (b - a) / D as the normal, the row is therefore exactly the gradient
of D. This vector is slightly shorter than 1. D is larger than the distance d of the cores, by e / (4 d) at most.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp, dot, products, segment_box, segment_segment, size_of
from q2r2_control.control.geometry.collision import (
    BodyPlacements,
    CollisionBodies,
    CollisionData,
    CollisionModel,
    Contact,
)
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.types import Array


@inlined_kernel
def at_least(model: CollisionModel, data: CollisionData, p: int) -> float:
    """Return a cheap lower bound on the distance of pair ``p`` [m].

    It is the distance of two balls around both bodies, or of a ball around the first body and the second body's box.
    """
    bodies, posed, first, second = model.bodies, data.posed, model.pairs.first[p], model.pairs.second[p]
    square = 0.0
    if bodies.box[second] == 1:
        x = 0.5 * (posed.start[first, 0] + posed.end[first, 0]) - posed.start[second, 0]
        y = 0.5 * (posed.start[first, 1] + posed.end[first, 1]) - posed.start[second, 1]
        z = 0.5 * (posed.start[first, 2] + posed.end[first, 2]) - posed.start[second, 2]
        axes = posed.rotation[second]
        inside = np.inf
        for k in range(3):
            depth = bodies.half[second, k] - abs(axes[0, k] * x + axes[1, k] * y + axes[2, k] * z)
            inside = min(inside, depth)
            square += min(depth, 0.0) ** 2
        return (-inside if inside > 0.0 else np.sqrt(square)) - bodies.size[first] - bodies.radius[second]
    for k in range(3):
        between = posed.start[first, k] + posed.end[first, k] - posed.start[second, k] - posed.end[second, k]
        square += between * between
    return 0.5 * np.sqrt(square) - bodies.size[first] - bodies.size[second]


@kernel
def measure(model: CollisionModel, data: CollisionData, p: int) -> float:
    """Return the signed distance [m] of pair ``p``, and fill ``data.contact``.

    The closest points in ``data.contact`` lie on the core segments, and not on the surfaces of the capsules. Points on
    the core and on the surface differ by a multiple of the normal, which does not change the rate of the distance.
    """
    first = model.pairs.first[p]
    return measure_part(model, data, p, data.posed.start[first], data.posed.end[first])


@inlined_kernel
def measure_part(model: CollisionModel, data: CollisionData, p: int, start: Array, end: Array) -> float:
    """Measure like :func:`measure`, with only the part from ``start`` to ``end`` (3,) of the pair's first geometry."""
    bodies, posed, first, second = model.bodies, data.posed, model.pairs.first[p], model.pairs.second[p]
    if bodies.box[second] == 1:
        cores = _to_box(start, end, posed.start[second], posed.rotation[second], bodies.half[second], data.contact)
    else:
        cores = _to_segment(start, end, posed.start[second], posed.end[second], data.contact)
    return cores - bodies.radius[first] - bodies.radius[second]


@kernel
def _to_box(start: Array, end: Array, centre: Array, axes: Array, half: Array, contact: Contact) -> float:
    """Return the signed distance [m] of a segment and a box with ``axes`` (3, 3) and ``half`` sides (3,)."""
    local = contact.local
    normal = local[2]
    _into_box_frame(start, end, centre, axes, local)
    distance = segment_box(local[0], local[1], half, contact.first, contact.second, normal)
    _into_world(contact.first, centre, axes)
    _into_world(contact.second, centre, axes)
    for row in range(3):
        contact.normal[row] = dot(axes[row], normal)
    return distance


@kernel
def _into_box_frame(start: Array, end: Array, centre: Array, axes: Array, local: Array) -> None:
    """Transform two points (3,) of the world frame into the frame of the box, and write them into ``local``."""
    for k in range(3):
        local[0, k], local[1, k] = 0.0, 0.0
        for row in range(3):
            local[0, k] += axes[row, k] * (start[row] - centre[row])
            local[1, k] += axes[row, k] * (end[row] - centre[row])


@kernel
def _into_world(point: Array, centre: Array, axes: Array) -> None:
    """Transform a point (3,) of the box frame into the world frame, in place."""
    x, y, z = point[0], point[1], point[2]
    for row in range(3):
        point[row] = centre[row] + axes[row, 0] * x + axes[row, 1] * y + axes[row, 2] * z


@kernel
def _to_segment(start: Array, end: Array, other_start: Array, other_end: Array, contact: Contact) -> float:
    """Return the distance [m] of two segments."""
    distance = segment_segment(start, end, other_start, other_end, contact.first, contact.second)
    if distance > 1e-9:
        for k in range(3):
            contact.normal[k] = (contact.second[k] - contact.first[k]) / distance
    else:
        _any_normal(start, end, other_start, other_end, contact.normal)
    return distance


@kernel
def _any_normal(a0: Array, a1: Array, b0: Array, b1: Array, normal: Array) -> None:
    """Write a unit normal for two segments that touch.

    It is perpendicular to both segments. If they are parallel, it is the direction from one middle to the other.
    """
    between = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal[k] = (a1[i] - a0[i]) * (b1[j] - b0[j]) - (a1[j] - a0[j]) * (b1[i] - b0[i])
        between += normal[k] * (b0[k] + b1[k] - a0[k] - a1[k])
    if dot(normal, normal) < 1e-18:
        for k in range(3):
            normal[k] = b0[k] + b1[k] - a0[k] - a1[k]
    if dot(normal, normal) < 1e-18:
        normal[2] = 1.0
    normal /= size_of(normal) if between >= 0.0 else -size_of(normal)


@kernel
def distance_row(model: CollisionModel, data: CollisionData, p: int, row: Array) -> None:
    """Write the gradient of pair ``p``'s distance with respect to q into ``row`` (nv,) [m/rad].

    The pair has to be the one that was measured last in ``data``.
    """
    chain, pairs, placements, contact = model.chain, model.pairs, data.placements, data.contact
    row[:] = 0.0
    nx, ny, nz = contact.normal[0], contact.normal[1], contact.normal[2]
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        sign = pairs.sign[p, k]
        ax, ay, az = placements.axis[joint, 0], placements.axis[joint, 1], placements.axis[joint, 2]
        if chain.prismatic[joint] == 1:
            row[joint - 1] = sign * (nx * ax + ny * ay + nz * az)
            continue
        point, origin = contact.first if sign < 0.0 else contact.second, placements.translation[joint]
        x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
        row[joint - 1] = sign * (nx * (ay * z - az * y) + ny * (az * x - ax * z) + nz * (ax * y - ay * x))


# Largest radius of a box's rounded edges, as a share of half the thickness of the box.
_THICKEST_SKIN = 0.9


def with_rounded_boxes(model: CollisionModel, depth: Array) -> CollisionModel:
    """Return a model with rounded boxes for the pairs with a ``depth`` (p,) [m] above 0.

    The radius of the edges is the depth, or less if the box is thin. All other pairs have the boxes without rounded
    edges. The pairs keep their order.
    """
    bodies, pairs = model.bodies, model.pairs
    second = pairs.second.copy()
    number: dict[tuple[int, float], int] = {}  # Index of each rounded box, by its original box and its radius.
    for p in np.flatnonzero((depth > 0.0) & (bodies.box[second] == 1)):
        box = int(second[p])
        skin = min(float(depth[p]), _THICKEST_SKIN * float(bodies.half[box].min()))
        second[p] = number.setdefault((box, skin), len(bodies.joint) + len(number))
    if not number:
        return model
    sources, skins = [box for box, _ in number], np.array([skin for _, skin in number])
    half = bodies.half[sources] - skins[:, None]
    rounded = {"radius": skins, "half": half, "size": np.linalg.norm(half, axis=1) + skins}
    joined = {
        name: np.concatenate([array, rounded.get(name, array[sources])]) for name, array in bodies._asdict().items()
    }
    return model._replace(bodies=CollisionBodies(**joined), pairs=pairs._replace(second=second))


def deeper_at_corners(model: CollisionModel, kept: Array) -> Array:
    """Return how much deeper than the permitted depth -``kept`` (p,) [m] a body can enter a box at a sharp corner.

    The model's boxes have rounded corners, and the real boxes have sharp ones. The result (p,) [m] is 0 for pairs that
    must not touch (``kept`` at least 0), and for pairs without a box.
    """
    boxed = (kept < 0.0) & (model.bodies.box[model.pairs.second] == 1)
    return np.where(boxed, (1.0 - 1.0 / np.sqrt(3.0)) * model.bodies.radius[model.pairs.first], 0.0)


_HALVINGS = 40  # Number of steps of the bisection.


@kernel
def measure_smooth(model: CollisionModel, data: CollisionData, p: int, smoothing: float) -> float:
    """Return the smooth signed distance [m] of pair ``p``, and fill ``data.contact``.

    The core of a capsule is its segment, and the core of a rounded box is the box without the rounding. The two cores
    must not touch. ``smoothing`` is the weight e of the small cost in the module's docstring [m^2].
    """
    bodies, posed, contact = model.bodies, data.posed, data.contact
    first, second = model.pairs.first[p], model.pairs.second[p]
    start, end = posed.start[first], posed.end[first]
    if bodies.box[second] == 1:
        core = _segment_box(start, end, posed, bodies.half[second], second, smoothing, contact)
    else:
        core = _segment_segment(start, end, posed.start[second], posed.end[second], smoothing, contact)
    for k in range(3):
        contact.normal[k] = (contact.second[k] - contact.first[k]) / core
    return core - bodies.radius[first] - bodies.radius[second]


@kernel
def _segment_segment(a0: Array, a1: Array, b0: Array, b1: Array, smoothing: float, contact: Contact) -> float:
    """Return the smooth distance D of two segments, as the module's docstring defines it [m].

    The quadratic function that is minimised is strictly convex, so no case is degenerate.
    """
    aa, bb, ab, ar, br = products(a0, a1, b0, b1)
    aa, bb, ar, br = aa + smoothing, bb + smoothing, ar - 0.5 * smoothing, br + 0.5 * smoothing
    s = clamp((ab * br - ar * bb) / (aa * bb - ab * ab), 0.0, 1.0)
    t = (ab * s + br) / bb
    if t < 0.0 or t > 1.0:
        t = clamp(t, 0.0, 1.0)
        s = clamp((ab * t - ar) / aa, 0.0, 1.0)
    square = smoothing * ((s - 0.5) ** 2 + (t - 0.5) ** 2)
    for k in range(3):
        contact.first[k] = a0[k] + s * (a1[k] - a0[k])
        contact.second[k] = b0[k] + t * (b1[k] - b0[k])
        square += (contact.first[k] - contact.second[k]) ** 2
    return np.sqrt(square)


@kernel
def _segment_box(
    a0: Array, a1: Array, posed: BodyPlacements, half: Array, box: int, smoothing: float, contact: Contact
) -> float:
    """Return the smooth distance D of a segment and a box, as the module's docstring defines it [m].

    The slope of D^2 rises strictly with s, so bisection finds its zero.
    """
    axes, centre, start, along = posed.rotation[box], posed.start[box], contact.local[0], contact.local[1]
    _into_box_frame(a0, a1, centre, axes, contact.local)
    along -= start
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        s = 0.5 * (low + high)
        slope = smoothing * (s - 0.5)
        for k in range(3):
            point = start[k] + s * along[k]
            slope += (point - clamp(point, -half[k], half[k])) * along[k]
        if slope > 0.0:
            high = s
        else:
            low = s
    s = 0.5 * (low + high)
    square = smoothing * (s - 0.5) ** 2
    for k in range(3):
        contact.first[k] = a0[k] + s * (a1[k] - a0[k])
        point = start[k] + s * along[k]
        contact.second[k] = clamp(point, -half[k], half[k])
        square += (point - contact.second[k]) ** 2
    _into_world(contact.second, centre, axes)
    return np.sqrt(square)
