"""Signed distances of monitored pairs and the rows that are their gradients, compiled.

For the closest points p1, p2 and the unit normal n from the first body to the second, the distance changes with
d' = n' (J_p2 - J_p1) v: only joints that move one body relative to the other appear in it.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import dot, segment_box, segment_segment
from q2r2_control.control.geometry.collision import CollisionBodies, CollisionData, CollisionModel, Contact
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.types import Array


@inlined_kernel
def at_least(model: CollisionModel, data: CollisionData, p: int) -> float:
    """Cheap lower bound on the distance of pair ``p``, from the balls around its bodies, or ball and box [m]."""
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


@inlined_kernel
def measure(model: CollisionModel, data: CollisionData, p: int) -> float:
    """Signed distance [m] of pair ``p``; fills ``data.contact``.

    The points lie on the core segment, not on the capsule's surface: they differ by a multiple of the normal, which
    changes no rate of distance.
    """
    first = model.pairs.first[p]
    return measure_part(model, data, p, data.posed.start[first], data.posed.end[first])


@inlined_kernel
def measure_part(model: CollisionModel, data: CollisionData, p: int, start: Array, end: Array) -> float:
    """As :func:`measure`, of the part from ``start`` to ``end``, (3,) each, of the pair's first geometry."""
    bodies, posed, first, second = model.bodies, data.posed, model.pairs.first[p], model.pairs.second[p]
    if bodies.box[second] == 1:
        cores = _to_box(start, end, posed.start[second], posed.rotation[second], bodies.half[second], data.contact)
    else:
        cores = _to_segment(start, end, posed.start[second], posed.end[second], data.contact)
    return cores - bodies.radius[first] - bodies.radius[second]


@kernel
def _to_box(start: Array, end: Array, centre: Array, axes: Array, half: Array, contact: Contact) -> float:
    """Signed distance [m] of a segment and a box, of which ``axes`` (3, 3) and ``half`` sides (3,) are given."""
    local = contact.local
    for k in range(3):
        along_start = 0.0
        along_end = 0.0
        for row in range(3):
            along_start += axes[row, k] * (start[row] - centre[row])
            along_end += axes[row, k] * (end[row] - centre[row])
        local[0, k] = along_start
        local[1, k] = along_end
    normal = local[2]
    distance = segment_box(local[0], local[1], half, contact.first, contact.second, normal)
    for points in (contact.first, contact.second):
        x, y, z = points[0], points[1], points[2]
        for row in range(3):
            points[row] = centre[row] + axes[row, 0] * x + axes[row, 1] * y + axes[row, 2] * z
    for row in range(3):
        contact.normal[row] = axes[row, 0] * normal[0] + axes[row, 1] * normal[1] + axes[row, 2] * normal[2]
    return distance


@kernel
def _to_segment(start: Array, end: Array, other_start: Array, other_end: Array, contact: Contact) -> float:
    """Distance [m] of two segments."""
    distance = segment_segment(start, end, other_start, other_end, contact.first, contact.second)
    if distance > 1e-9:
        for k in range(3):
            contact.normal[k] = (contact.second[k] - contact.first[k]) / distance
    else:
        _any_normal(start, end, other_start, other_end, contact.normal)
    return distance


@kernel
def _any_normal(a0: Array, a1: Array, b0: Array, b1: Array, normal: Array) -> None:
    """A unit normal for segments that touch: across both, or between their middles if they are parallel."""
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
    size = np.sqrt(dot(normal, normal)) if between >= 0.0 else -np.sqrt(dot(normal, normal))
    for k in range(3):
        normal[k] /= size


@kernel
def distance_row(model: CollisionModel, data: CollisionData, p: int, row: Array) -> None:
    """Gradient of pair ``p``'s distance with respect to q into ``row`` (nv,) [m/rad], as measured last."""
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
        if sign < 0.0:
            x, y, z = contact.first[0], contact.first[1], contact.first[2]
        else:
            x, y, z = contact.second[0], contact.second[1], contact.second[2]
        x -= placements.translation[joint, 0]
        y -= placements.translation[joint, 1]
        z -= placements.translation[joint, 2]
        row[joint - 1] = sign * (nx * (ay * z - az * y) + ny * (az * x - ax * z) + nz * (ax * y - ay * x))


# Of half a box's thickness: what its skin takes at most.
_THICKEST_SKIN = 0.9


def with_rounded_boxes(model: CollisionModel, depth: Array) -> CollisionModel:
    """A model whose pairs with ``depth`` (p,) [m] above 0 see a box rounded by that much, or by as much as it is thick.

    Every other pair sees the boxes as they are. Pairs keep their order.
    """
    bodies, pairs = model.bodies, model.pairs
    second = pairs.second.copy()
    sources: list[int] = []
    skins: list[float] = []
    for p in np.flatnonzero((depth > 0.0) & (bodies.box[second] == 1)):
        box = int(second[p])
        skin = min(float(depth[p]), _THICKEST_SKIN * float(bodies.half[box].min()))
        if (box, skin) not in zip(sources, skins, strict=True):
            sources.append(box)
            skins.append(skin)
        second[p] = len(bodies.joint) + list(zip(sources, skins, strict=True)).index((box, skin))
    if not sources:
        return model
    half = bodies.half[sources] - np.array(skins)[:, None]
    size = np.linalg.norm(half, axis=1) + skins
    rounded = {"radius": np.array(skins), "half": half, "size": size}
    joined = {
        name: np.concatenate([array, rounded.get(name, array[sources])]) for name, array in bodies._asdict().items()
    }
    return model._replace(bodies=CollisionBodies(**joined), pairs=pairs._replace(second=second))


def deeper_at_corners(model: CollisionModel, kept: Array) -> Array:
    """How much deeper than -``kept`` (p,) [m] pairs that may touch can get into a real corner (p,) [m]; else 0."""
    boxed = (kept < 0.0) & (model.bodies.box[model.pairs.second] == 1)
    return np.where(boxed, (1.0 - 1.0 / np.sqrt(3.0)) * model.bodies.radius[model.pairs.first], 0.0)


def deepest(model: CollisionModel, radius: Array) -> Array:
    """How far the two bodies of each pair may get into each other until their cores meet (p,) [m].

    ``radius`` (g,) are the least that the bodies ever have [m].
    """
    return radius[model.pairs.first] + radius[model.pairs.second]
