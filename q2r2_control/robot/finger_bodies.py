"""Compute the bodies of fingers. Each body is the volume that a finger sweeps over the travel of its joints.

The kernels know the positions of the arm's joints, but not of the finger joints. The body of a finger therefore covers
all positions of the finger. While the opening of the gripper is known, a smaller body replaces it: a part of the
capsule's segment if the finger slides, or a capsule of turning_fingers.py if the finger turns.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.robot.description import LinkTree, joint_end, joint_limits
from q2r2_control.robot.enclose import capsule_between, enclosing_capsule
from q2r2_control.robot.followers import Follower, followers_of
from q2r2_control.robot.pairs import KnownParts, link_of, links_moved_by
from q2r2_control.robot.pinocchio_models import joint_axis
from q2r2_control.robot.turning_fingers import FingerJoint, TurningBody, TurningSweeps
from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval


@dataclass(frozen=True, slots=True)
class FingerBody:
    """A body that covers all positions of some fingers of one arm. These fingers slide along one line."""

    arm: str
    name: str  # Name of the geometry object.
    length: float  # Length of its segment [m].
    # The ends of the fingers' shapes: their positions along the segment at home [m]. Each end has the joints that move
    # it, with the share of the joint's travel that is along the line.
    ends: tuple[tuple[float, tuple[tuple[float, FingerJoint], ...]], ...]

    def part(self, interval: Interval) -> tuple[float, float]:
        """Return the part of the segment in which the fingers are while the gripper's opening is in ``interval``.

        Both ends of the part are given as shares of the segment's length, from 0 to 1.
        """
        if interval == ALL_OF_THE_WAY:
            return 0.0, 1.0
        lowest, highest = [], []
        for at, slides in self.ends:
            ways = [[along * (end - joint.home) for end in joint.travel(interval)] for along, joint in slides]
            lowest.append(at + sum(map(min, ways)))
            highest.append(at + sum(map(max, ways)))
        return max(min(lowest) / self.length, 0.0), min(max(highest) / self.length, 1.0)


def part_of_segment(start: Array, end: Array, part: tuple[float, float]) -> tuple[Array, Array]:
    """Return both ends (3,) of a part of the segment from ``start`` to ``end`` (3,).

    For (0, 1) these are exactly ``start`` and ``end``.
    """
    along = end - start
    return start + part[0] * along, end - (1.0 - part[1]) * along


def collision_model_at(
    geometry: pin.GeometryModel, fingers: Iterable[FingerBody | TurningBody], openings: Mapping[str, Interval]
) -> pin.GeometryModel:
    """Return a copy of ``Robot.collision_model`` whose bodies of fingers fit the ``openings``, by arm.

    Fingers of other arms keep the body that covers all their positions.
    """
    made, bodies = geometry.copy(), list(fingers)
    for arm, interval in openings.items():
        if interval == ALL_OF_THE_WAY:
            continue
        of_arm = [body for body in bodies if body.arm == arm]
        capsules: dict[str, tuple[float, Array, Array]] = {}
        for body in of_arm:
            if isinstance(body, FingerBody):
                item = made.geometryObjects[made.getGeometryId(body.name)]
                start, end = _ends(item)
                capsules[body.name] = float(item.geometry.radius), *part_of_segment(start, end, body.part(interval))
        # All fingers of an arm are computed together, as in the kernels, because they share the number of samples.
        if turning := [body for body in of_arm if isinstance(body, TurningBody)]:
            for body, start, end, radius in zip(turning, *TurningSweeps(turning).capsules(interval), strict=True):
                capsules[body.name] = float(radius), start, end
        for name, capsule in capsules.items():
            item = made.geometryObjects[made.getGeometryId(name)]
            item.geometry, item.placement = capsule_between(*capsule)
    return made


_ON_ONE_LINE = 1e-9  # [m]
_KINDS = {"revolute", "prismatic"}  # The kinds of joints that move a finger.

# Both ends of a shape in the model (2, 3) [m], and the joints that move them.
_Finger = tuple[Array, tuple[FingerJoint, ...]]


def sweep_fingers(
    model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree, parts: KnownParts, home: Mapping[str, float]
) -> tuple[FingerBody | TurningBody, ...]:
    """Replace the capsules and spheres of fingers in place by capsules around the volumes that they sweep.

    In ``model`` the fingers are locked at ``home``.

    If two fingers of one gripper slide on one line and are equally thick, their capsules become one. It keeps the name
    of the first capsule, and includes the space between the fingers. If a finger slides across the line of its body,
    this body always covers all positions. A finger that is moved by a joint with more than one axis keeps its shape.

    Returns:
        The bodies that become smaller while the gripper's opening is known. They belong to fingers that slide along the
        line of their body, and to fingers that turn.
    """
    bodies: list[FingerBody | TurningBody] = []
    for arm, joints in parts.finger_joints.items():
        links, stroke = links_moved_by(tree, joints), parts.strokes.get(arm)
        # The gripper moves its joints from closed to open. Without a stroke, it drives none of them.
        followers = followers_of(tree.joint_to.values(), joints if stroke is not None else ())
        swept: dict[str, list[_Finger] | None] = {}
        for item in geometry.geometryObjects:
            if (link := link_of(item.name)) not in links:
                continue
            # The finger joints that move the body, from the base of the gripper outwards.
            chain = [joint for joint in tree.chain(link) if joint_end(joint, "child") in links]
            kinds = {joint.get("type", "") for joint in chain}
            if not chain or not kinds <= _KINDS:
                continue
            moving = tuple(_finger_joint(model, tree, joint, home, followers, stroke) for joint in chain)
            if "revolute" in kinds:
                body = TurningBody(arm, item.name, _ends(item), float(item.geometry.radius), moving)
                start, end, radius = body.capsule(ALL_OF_THE_WAY)
                item.geometry, item.placement = capsule_between(radius, start, end)
                bodies += [body] if stroke is not None else []
            else:
                drawn = _ends(item)
                swept[item.name] = [(drawn, moving)] if _sweep(item, moving) else None
        for name, fingers in _merge(geometry, swept).items():
            start, end = _ends(geometry.geometryObjects[geometry.getGeometryId(name)])
            length = float(np.linalg.norm(end - start))
            if fingers and stroke is not None and length > _ON_ONE_LINE:
                along = (end - start) / length
                ends = tuple(
                    (float((point - start) @ along), tuple((float(joint.axis @ along), joint) for joint in moving))
                    for drawn, moving in fingers
                    for point in drawn
                )
                bodies.append(FingerBody(arm, name, length, ends))
    return tuple(bodies)


def _finger_joint(
    model: pin.Model,
    tree: LinkTree,
    joint: ET.Element,
    home: Mapping[str, float],
    followers: Mapping[str, Follower],
    stroke: tuple[float, float] | None,
) -> FingerJoint:
    """Return a joint of a finger that is locked at ``home`` in ``model``.

    ``stroke`` [m or rad] moves the gripper's joints from closed to open. Without a stroke, a joint without a <mimic>
    may be anywhere in its limits. A joint in ``followers`` follows its driver in all positions, also at the driver's
    limits.
    """
    name = joint.get("name", "")
    followed = followers.get(name, Follower(name, 1.0, 0.0))
    lower, upper = joint_limits(next(one for one in tree.joint_to.values() if one.get("name") == followed.driver))
    closed, opened = (lower, upper) if stroke is None else stroke
    ends = closed, opened, *((lower, upper) if opened >= closed else (upper, lower))
    closed, opened, before, beyond = map(followed.at, ends)
    placement = model.frames[model.getFrameId(name, pin.FrameType.FIXED_JOINT)].placement
    axis: Array = placement.rotation @ joint_axis(joint)
    return FingerJoint(
        slides=joint.get("type") == "prismatic",
        axis=np.asarray(axis),
        point=np.array(placement.translation),
        home=home.get(name, 0.0),
        closed=closed,
        open=opened,
        before=before,
        beyond=beyond,
        driver=followed.driver,
    )


def _ends(item: pin.GeometryObject) -> Array:
    """Return both ends of a capsule's segment, or the centre of a sphere twice (2, 3) [m]."""
    half = item.geometry.halfLength if isinstance(item.geometry, coal.Capsule) else 0.0
    along = half * item.placement.rotation[:, 2]
    return np.array([item.placement.translation - along, item.placement.translation + along])


def _sweep(item: pin.GeometryObject, joints: tuple[FingerJoint, ...]) -> bool:
    """Replace a shape by a capsule around the volume that it sweeps.

    Returns True if the whole segment of the shape moves along one line.
    """
    ways = [[(end - joint.home) * joint.axis for end in (joint.before, joint.beyond)] for joint in joints]
    points = np.array([end + np.sum(move, axis=0) for move in product(*ways) for end in _ends(item)])
    radius, line = float(item.geometry.radius), _line_of(points)
    # A capsule is convex. If it encloses the corners of the swept segment, it encloses all of it.
    thicker, start, end = enclosing_capsule(points) if line is None else (0.0, *line)
    item.geometry, item.placement = capsule_between(radius + thicker, start, end)
    return line is not None


def _line_of(points: Array) -> Array | None:
    """Return both ends of the segment on which all ``points`` (n, 3) lie (2, 3); None if they are on no segment."""
    offsets = points - points[0]
    farthest = offsets[int(np.argmax(np.linalg.norm(offsets, axis=1)))]
    length = np.linalg.norm(farthest)
    if length <= _ON_ONE_LINE:
        return np.array([points[0], points[0]])
    along = offsets @ (farthest / length)
    if np.linalg.norm(offsets - np.outer(along, farthest / length), axis=1).max() > _ON_ONE_LINE:
        return None
    return np.array([points[int(np.argmin(along))], points[int(np.argmax(along))]])


def _merge(geometry: pin.GeometryModel, swept: dict[str, list[_Finger] | None]) -> dict[str, list[_Finger] | None]:
    """Join bodies whose axes lie on one line and whose radii are equal.

    Returns:
        For each body, the fingers that it contains; None if one of them moves across the line.
    """
    kept: dict[str, list[_Finger] | None] = {}
    for name, fingers in swept.items():
        item = geometry.geometryObjects[geometry.getGeometryId(name)]
        for other_name, others in kept.items():
            other = geometry.geometryObjects[geometry.getGeometryId(other_name)]
            line = _line_of(np.concatenate([_ends(other), _ends(item)]))
            if line is not None and abs(other.geometry.radius - item.geometry.radius) <= _ON_ONE_LINE:
                other.geometry, other.placement = capsule_between(float(other.geometry.radius), line[0], line[1])
                geometry.removeGeometryObject(name)
                kept[other_name] = None if fingers is None or others is None else others + fingers
                break
        else:
            kept[name] = fingers
    return kept
