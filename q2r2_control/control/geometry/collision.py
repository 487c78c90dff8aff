"""A robot's collision geometries and monitored pairs as arrays, and the geometries' poses at a posture (compiled).

Every geometry is a segment with a radius (capsule, sphere) or a box. A pair lists only the joints that move one of its
bodies relative to the other.
"""

from __future__ import annotations

from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements, chain_of, place
from q2r2_control.control.jit import kernel
from q2r2_control.errors import RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.types import Array


class CollisionBodies(NamedTuple):
    """The collision geometries, each in the frame of its joint.

    For a sliding finger, ``start`` and ``end`` change with its opening. For a turning finger, ``radius`` and ``size``
    change too, see :mod:`finger_openings`.
    """

    joint: IntArray  # (g,) Number of the joint to which the geometry is attached; 0 is the world.
    box: IntArray  # (g,) 1 for a box, 0 for a segment.
    start: Array  # (g, 3) Start of the segment, or centre of the box [m].
    end: Array  # (g, 3) End of the segment [m].
    radius: Array  # (g,) Radius [m]; for a box 0, or the radius of its rounded edges.
    half: Array  # (g, 3) Half sides of a box [m].
    rotation: Array  # (g, 3, 3) Rotation of a box.
    size: Array  # (g,) Radius of a ball that contains the geometry, with the geometry's middle as its centre [m].


class Pairs(NamedTuple):
    """The pairs of geometries that must not meet, and the joints that move them relative to each other."""

    first: IntArray  # (p,) Index of the first geometry, which is never a box.
    second: IntArray  # (p,) Index of the second geometry.
    joint: IntArray  # (p, k) Numbers of the joints, padded with 0.
    sign: Array  # (p, k) +1 if the joint moves the second geometry, -1 if it moves the first one.
    # (p, k) Bound on the distance of the geometry's points from the joint's axis [m]; 1 for a sliding joint.
    reach: Array
    leverage: Array  # (p,) Sum of ``reach`` over the joints.
    carried: IntArray  # (p,) 1 if some joint moves both geometries alike. Such a joint is not listed in ``joint``.


class CollisionModel(NamedTuple):
    """Data that do not change with the posture."""

    chain: Chain
    bodies: CollisionBodies
    pairs: Pairs


class BodyPlacements(NamedTuple):
    """Poses of the geometries in the world frame, written by :func:`update_placements`."""

    start: Array  # (g, 3) [m]
    end: Array  # (g, 3) [m]
    rotation: Array  # (g, 3, 3)


class Contact(NamedTuple):
    """The closest points of the pair that was measured last, in the world frame."""

    first: Array  # (3,) The closest point of the first body [m].
    second: Array  # (3,) The closest point of the second body [m].
    normal: Array  # (3,) Unit vector from the first to the second body.
    local: Array  # (3, 3) Buffer for vectors in the frame of a box.
    kept: Array  # (2, 3) Buffer that keeps closest points while parts of a segment are measured.

    @classmethod
    def empty(cls) -> Contact:
        return cls(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((2, 3)))


class CollisionData(NamedTuple):
    """Poses of joints and bodies, written by :func:`update_placements`, and the last measurement at this posture."""

    placements: Placements
    posed: BodyPlacements
    contact: Contact

    @classmethod
    def empty(cls, model: CollisionModel) -> CollisionData:
        g = len(model.bodies.joint)
        posed = BodyPlacements(np.zeros((g, 3)), np.zeros((g, 3)), np.zeros((g, 3, 3)))
        return cls(Placements.empty(model.chain), posed, Contact.empty())


def collision_model_of(robot: Robot, geometry: pin.GeometryModel | None = None) -> CollisionModel:
    """Return the joints, bodies and pairs of a robot.

    If ``geometry`` is given, its bodies and pairs are used. It begins with the robot's own bodies and pairs.

    Raises:
        RobotError: If the kernels cannot handle a joint, the shape of a body, or a pair.
    """
    geometry = robot.collision_model if geometry is None else geometry
    chain, bodies = chain_of(robot.model), bodies_of(geometry)
    travel = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    extent = farthest_of(bodies)
    # A turning finger has one capsule for each interval of openings. The capsule of a part of the whole interval may
    # reach beyond the capsule of the whole interval. The bound therefore covers the capsules of all intervals.
    for number, finger in turning_bodies(robot):
        extent[number] = max(extent[number], finger.extent)
    return CollisionModel(chain, bodies, pairs_of(geometry, chain, bodies, travel, extent))


def bodies_of(model: pin.GeometryModel) -> CollisionBodies:
    """Return the arrays of capsules, spheres and boxes; raises :class:`RobotError` for any other shape."""
    count = model.ngeoms
    bodies = CollisionBodies(
        joint=np.array([geometry.parentJoint for geometry in model.geometryObjects], dtype=np.int64),
        box=np.zeros(count, dtype=np.int64),
        start=np.zeros((count, 3)),
        end=np.zeros((count, 3)),
        radius=np.zeros(count),
        half=np.zeros((count, 3)),
        rotation=np.zeros((count, 3, 3)),
        size=np.zeros(count),
    )
    for i, geometry in enumerate(model.geometryObjects):
        shape, placement = geometry.geometry, geometry.placement
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


def turning_bodies(robot: Robot) -> list[tuple[int, TurningBody]]:
    """Return the fingers that turn, each with the number of its geometry."""
    numbers = {geometry.name: number for number, geometry in enumerate(robot.collision_model.geometryObjects)}
    return [(numbers[finger.name], finger) for finger in robot.finger_bodies if isinstance(finger, TurningBody)]


def farthest_of(bodies: CollisionBodies) -> Array:
    """Return the greatest distance of each segment or box from the origin of its joint's frame (g,) [m]."""
    ends = np.maximum(np.linalg.norm(bodies.start, axis=1), np.linalg.norm(bodies.end, axis=1))
    return np.asarray(np.linalg.norm(bodies.half, axis=1) + ends)


def pairs_of(model: pin.GeometryModel, chain: Chain, bodies: CollisionBodies, travel: Array, extent: Array) -> Pairs:
    """Return the monitored pairs of ``model``.

    Args:
        model: The geometries and their pairs.
        chain: The joints.
        bodies: The bodies of ``model``.
        travel: Greatest absolute position of each joint (nv,) [rad or m].
        extent: For each body, a bound (g,) on the distance of its segment or box from its joint's origin [m]. The bound
            still holds after bodies of fingers change.

    Raises:
        RobotError: If both bodies of a pair are boxes, because no kernel measures such a pair.
    """
    rows = []
    offsets = [float(np.linalg.norm(translation)) for translation in chain.translation]
    for pair in model.collisionPairs:
        first, second = (pair.second, pair.first) if bodies.box[pair.first] else (pair.first, pair.second)
        if bodies.box[first]:
            names = [model.geometryObjects[i].name for i in (first, second)]
            raise RobotError(f"pair {names[0]}, {names[1]}: two boxes; allowed: at most one box in a pair")
        moving: dict[int, tuple[float, float]] = {}
        carried = False
        for body, sign in ((first, -1.0), (second, 1.0)):
            farthest = extent[body]
            joint = int(bodies.joint[body])
            # Towards the base, the bound grows by the offset of each link, and by the travel of each sliding joint.
            while joint != 0:
                if chain.prismatic[joint]:
                    farthest += travel[joint - 1]
                if joint in moving:
                    del moving[joint]  # The joint moves both bodies equally, without relative motion.
                    carried = True
                else:
                    moving[joint] = (sign, 1.0 if chain.prismatic[joint] else float(farthest))
                farthest += offsets[joint]
                joint = int(chain.parent[joint])
        rows.append((first, second, moving, carried))
    width = max([len(moving) for _, _, moving, _ in rows], default=1)
    joints = np.zeros((len(rows), width), dtype=np.int64)
    signs, reaches = np.zeros((2, len(rows), width))
    for p, (_, _, moving, _) in enumerate(rows):
        for k, (joint, (sign, reach)) in enumerate(sorted(moving.items())):
            joints[p, k], signs[p, k], reaches[p, k] = joint, sign, reach
    firsts, seconds, carries = (np.array([row[i] for row in rows], dtype=np.int64) for i in (0, 1, 3))
    return Pairs(firsts, seconds, joints, signs, reaches, reaches.sum(axis=1), carries)


@kernel
def update_placements(model: CollisionModel, data: CollisionData, q: Array) -> None:
    """Write the poses of the joint frames and the geometries in the world frame, at the posture ``q`` (nv,)."""
    bodies, placements, posed = model.bodies, data.placements, data.posed
    place(model.chain, q, placements)
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
