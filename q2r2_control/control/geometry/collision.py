"""Monitored pairs as arrays, their signed distances, and the rows that keep them apart, compiled.

Every geometry is a segment with a radius (capsule, sphere) or a box. For the closest points p1, p2 and the unit normal
n from the first body to the second, the distance changes with d' = n' (J_p2 - J_p1) v: only joints that move one body
relative to the other appear in it.
"""

from __future__ import annotations

from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.control.geometry.closest_points import dot, segment_box, segment_segment
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.jit import lean_kernel
from q2r2_control.errors import RobotError
from q2r2_control.types import Array


class Bodies(NamedTuple):
    """Collision geometries in their joint's frame."""

    joint: IntArray  # (g,) 0 is the world
    box: IntArray  # (g,) 1 for a box
    start: Array  # (g, 3) segment start [m]; box: centre
    end: Array  # (g, 3) segment end [m]
    radius: Array  # (g,) [m]; box: 0
    half: Array  # (g, 3) half sides of a box [m]
    rotation: Array  # (g, 3, 3) of a box
    size: Array  # (g,) radius of the ball around the middle that holds it all [m]


class Pairs(NamedTuple):
    """Which geometries must not meet, and the joints that move them relative to each other."""

    first: IntArray  # (p,) geometry index; never a box
    second: IntArray  # (p,)
    joint: IntArray  # (p, k) joint indices, padded with 0
    sign: Array  # (p, k) +1: the joint moves the second geometry, -1: the first
    reach: Array  # (p, k) bound on how far the geometry's points are from the joint's axis [m]; 1 for a sliding joint
    leverage: Array  # (p,) sum of reach
    round: IntArray  # (p,) 1 where both are capsules, whose normal turns as they slide past each other


class Posed(NamedTuple):
    """Geometries in the world, written by :func:`pose_bodies`."""

    start: Array  # (g, 3)
    end: Array  # (g, 3)
    rotation: Array  # (g, 3, 3)

    @classmethod
    def empty(cls, bodies: Bodies) -> Posed:
        g = len(bodies.joint)
        return cls(np.zeros((g, 3)), np.zeros((g, 3)), np.zeros((g, 3, 3)))


class Contact(NamedTuple):
    """Scratch for one pair: closest points and normal in the world, (3,) each."""

    first: Array
    second: Array
    normal: Array
    local: Array  # (3, 3)
    witness: Array  # (3,)

    @classmethod
    def empty(cls) -> Contact:
        return cls(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(3))


def bodies_of(model: pin.GeometryModel) -> Bodies:
    """Read capsules, spheres and boxes. Raises :class:`RobotError` for any other shape."""
    count = model.ngeoms
    bodies = Bodies(
        joint=np.zeros(count, dtype=np.int64),
        box=np.zeros(count, dtype=np.int64),
        start=np.zeros((count, 3)),
        end=np.zeros((count, 3)),
        radius=np.zeros(count),
        half=np.zeros((count, 3)),
        rotation=np.tile(np.eye(3), (count, 1, 1)),
        size=np.zeros(count),
    )
    for i, geometry in enumerate(model.geometryObjects):
        shape, placement = geometry.geometry, geometry.placement
        bodies.joint[i] = geometry.parentJoint
        bodies.rotation[i] = placement.rotation
        reach = placement.rotation[:, 2] * (shape.halfLength if isinstance(shape, coal.Capsule) else 0.0)
        bodies.start[i], bodies.end[i] = placement.translation - reach, placement.translation + reach
        if isinstance(shape, coal.Capsule | coal.Sphere):
            bodies.radius[i] = shape.radius
        elif isinstance(shape, coal.Box):
            bodies.box[i], bodies.half[i] = 1, shape.halfSide
        else:
            raise RobotError(f"geometry {geometry.name}: {type(shape).__name__}; allowed: capsule, sphere, box")
        middle_to_end = 0.5 * np.linalg.norm(bodies.end[i] - bodies.start[i])
        bodies.size[i] = middle_to_end + bodies.radius[i] + np.linalg.norm(bodies.half[i])
    return bodies


def pairs_of(model: pin.GeometryModel, chain: Chain, bodies: Bodies, travel: Array) -> Pairs:
    """Monitored pairs of ``model``; ``travel`` (nv,) is how far each joint can be from zero [rad or m].

    Raises :class:`RobotError` for a pair of two boxes, which no kernel measures.
    """
    parent, translation, prismatic = chain.parent, chain.translation, chain.prismatic
    rows = []
    for pair in model.collisionPairs:
        first, second = (pair.second, pair.first) if bodies.box[pair.first] else (pair.first, pair.second)
        if bodies.box[first]:
            names = [model.geometryObjects[i].name for i in (first, second)]
            raise RobotError(f"pair {names[0]}, {names[1]}: two boxes; allowed: at most one box in a pair")
        moving: dict[int, tuple[float, float]] = {}
        for body, sign in ((first, -1.0), (second, 1.0)):
            farthest = np.linalg.norm(bodies.half[body]) + max(
                np.linalg.norm(bodies.start[body]), np.linalg.norm(bodies.end[body])
            )
            joint = int(bodies.joint[body])
            # Walking up, the bound grows by each link's offset and by how far each slide extends.
            while joint != 0:
                if prismatic[joint]:
                    farthest += travel[joint - 1]
                if joint in moving:
                    del moving[joint]  # moves both alike: no relative motion
                else:
                    moving[joint] = (sign, 1.0 if prismatic[joint] else float(farthest))
                farthest += np.linalg.norm(translation[joint])
                joint = int(parent[joint])
        rows.append((first, second, moving))
    width = max([len(moving) for _, _, moving in rows], default=1)
    pairs = Pairs(
        first=np.array([row[0] for row in rows], dtype=np.int64),
        second=np.array([row[1] for row in rows], dtype=np.int64),
        joint=np.zeros((len(rows), width), dtype=np.int64),
        sign=np.zeros((len(rows), width)),
        reach=np.zeros((len(rows), width)),
        leverage=np.zeros(len(rows)),
        round=np.array([1 - bodies.box[row[1]] for row in rows], dtype=np.int64),
    )
    for p, (_, _, moving) in enumerate(rows):
        for k, (joint, (sign, reach)) in enumerate(sorted(moving.items())):
            pairs.joint[p, k], pairs.sign[p, k], pairs.reach[p, k] = joint, sign, reach
            pairs.leverage[p] += reach
    return pairs


@lean_kernel
def pose_bodies(bodies: Bodies, placements: Placements, posed: Posed) -> None:
    """Move every geometry to the world."""
    for g in range(bodies.joint.shape[0]):
        joint = bodies.joint[g]
        for row in range(3):
            start = placements.translation[joint, row]
            end = start
            for k in range(3):
                start += placements.rotation[joint, row, k] * bodies.start[g, k]
                end += placements.rotation[joint, row, k] * bodies.end[g, k]
            posed.start[g, row] = start
            posed.end[g, row] = end
            if bodies.box[g] == 1:
                for column in range(3):
                    turned = 0.0
                    for k in range(3):
                        turned += placements.rotation[joint, row, k] * bodies.rotation[g, k, column]
                    posed.rotation[g, row, column] = turned


@lean_kernel
def at_least(bodies: Bodies, posed: Posed, first: int, second: int) -> float:
    """Cheap lower bound on the distance of two geometries, from the balls around them, or ball and box [m]."""
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
        return (-inside if inside > 0.0 else np.sqrt(square)) - bodies.size[first]
    for k in range(3):
        between = posed.start[first, k] + posed.end[first, k] - posed.start[second, k] - posed.end[second, k]
        square += between * between
    return 0.5 * np.sqrt(square) - bodies.size[first] - bodies.size[second]


@lean_kernel
def measure(bodies: Bodies, posed: Posed, first: int, second: int, start: Array, end: Array, contact: Contact) -> float:
    """Signed distance [m] of the part ``start``-``end`` of geometry ``first`` from ``second``; fills ``contact``.

    The points lie on the core segment, not on the capsule's surface: they differ by a multiple of the normal, which
    changes no rate of distance.
    """
    if bodies.box[second] == 1:
        local = contact.local
        axes = posed.rotation[second]
        for k in range(3):
            along_start = 0.0
            along_end = 0.0
            for row in range(3):
                along_start += axes[row, k] * (start[row] - posed.start[second, row])
                along_end += axes[row, k] * (end[row] - posed.start[second, row])
            local[0, k] = along_start
            local[1, k] = along_end
        normal = local[2]
        distance = segment_box(local[0], local[1], bodies.half[second], contact.first, contact.second, normal)
        for points in (contact.first, contact.second):
            x, y, z = points[0], points[1], points[2]
            for row in range(3):
                points[row] = posed.start[second, row] + axes[row, 0] * x + axes[row, 1] * y + axes[row, 2] * z
        for row in range(3):
            contact.normal[row] = axes[row, 0] * normal[0] + axes[row, 1] * normal[1] + axes[row, 2] * normal[2]
        return distance - bodies.radius[first]
    distance = segment_segment(start, end, posed.start[second], posed.end[second], contact.first, contact.second)
    if distance > 1e-9:
        for k in range(3):
            contact.normal[k] = (contact.second[k] - contact.first[k]) / distance
    else:
        _any_normal(posed.start[first], posed.end[first], posed.start[second], posed.end[second], contact.normal)
    return distance - bodies.radius[first] - bodies.radius[second]


@lean_kernel
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


@lean_kernel
def distance_row(chain: Chain, placements: Placements, pairs: Pairs, p: int, contact: Contact, row: Array) -> None:
    """Gradient of pair ``p``'s distance with respect to q into ``row`` (nv,) [m/rad]."""
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
