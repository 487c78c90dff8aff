"""The bodies of fingers: each is what it sweeps from one end of its joints' travel to the other.

Distances know arm joints only, so a finger's body is all of its way. While the gripper's opening is known, less of it
counts. Of fingers that slide it is a part of the segment, of those that turn a capsule of turning_fingers.py.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Mapping
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
    """A body that is all of the way of one arm's fingers along a line."""

    arm: str
    name: str  # of the geometry
    length: float  # of its segment [m]
    # Places along the segment at home [m], and the joints that move each, with the part of their way along the line.
    ends: tuple[tuple[float, tuple[tuple[float, FingerJoint], ...]], ...]

    def part(self, interval: Interval) -> tuple[float, float]:
        """Which part of the segment, from 0 its start to 1 its end, the fingers are in at openings in ``interval``."""
        if interval == ALL_OF_THE_WAY:
            return 0.0, 1.0
        lowest, highest = [], []
        for at, slides in self.ends:
            ways = [[along * (end - joint.home) for end in joint.travel(interval)] for along, joint in slides]
            lowest.append(at + sum(map(min, ways)))
            highest.append(at + sum(map(max, ways)))
        return max(min(lowest) / self.length, 0.0), min(max(highest) / self.length, 1.0)


def part_of_segment(start: Array, end: Array, part: tuple[float, float]) -> tuple[Array, Array]:
    """Both ends (3,) of a part of the segment from ``start`` to ``end`` (3,); all of it is exact."""
    along = end - start
    return start + part[0] * along, end - (1.0 - part[1]) * along


def collision_model_at(
    geometry: pin.GeometryModel, fingers: Iterable[FingerBody | TurningBody], openings: Mapping[str, Interval]
) -> pin.GeometryModel:
    """A copy of ``Robot.collision_model`` with fingers as they are at ``openings`` by arm, others all of their way."""
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
        # All of an arm's at once, as the kernels have them: the number of samples depends on all of them.
        if turning := [body for body in of_arm if isinstance(body, TurningBody)]:
            for body, start, end, radius in zip(turning, *TurningSweeps(turning).capsules(interval), strict=True):
                capsules[body.name] = float(radius), start, end
        for name, capsule in capsules.items():
            item = made.geometryObjects[made.getGeometryId(name)]
            item.geometry, item.placement = capsule_between(*capsule)
    return made


_ON_ONE_LINE = 1e-9  # [m]
_KINDS = {"revolute", "prismatic"}  # of joints

# Both ends of a shape as it was drawn (2, 3) [m] and what moves them.
_Finger = tuple[Array, tuple[FingerJoint, ...]]


def sweep_fingers(
    model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree, parts: KnownParts, home: Mapping[str, float]
) -> tuple[FingerBody | TurningBody, ...]:
    """Replace in place the capsules and spheres of fingers, locked at ``home``, by what they sweep.

    Capsules of two fingers of one gripper that slide on one line and are equally thick become one. It keeps the first
    one's name, and the space between the fingers is part of it. Returns the bodies of which less counts where the
    gripper's opening is known: those along whose line the fingers slide, and those that turn. A finger that slides
    across its body is all of its way always. One that is moved by a joint of more than one axis stays as it is.
    """
    bodies: list[FingerBody | TurningBody] = []
    for arm, joints in parts.finger_joints.items():
        links, stroke = links_moved_by(tree, joints), parts.strokes.get(arm)
        swept: dict[str, list[_Finger] | None] = {}
        for item in geometry.geometryObjects:
            # The finger joints that carry the body, from the hand outwards.
            chain = [joint for joint in tree.chain(link_of(item.name)) if joint_end(joint, "child") in links]
            kinds = {joint.get("type", "") for joint in chain}
            if not chain or not kinds <= _KINDS:
                continue
            moving = tuple(_finger_joint(model, tree, joint, home, joints, stroke) for joint in chain)
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
    driven: Collection[str],
    stroke: tuple[float, float] | None,
) -> FingerJoint:
    """A joint of a finger that is locked at ``home`` in ``model``.

    ``driven`` are the joints that the gripper moves from closed to open, which is its ``stroke`` [m or rad]. Without
    one, any joint that mimics none may be anywhere in its limits. One that mimics is where that puts it, also where
    the joint that it follows is at the end of its travel.
    """
    name = joint.get("name", "")
    followers = followers_of(tree.joint_to.values(), driven if stroke is not None else ())
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
    """Ends of a capsule's segment, or a sphere's centre twice (2, 3) [m]."""
    half = item.geometry.halfLength if isinstance(item.geometry, coal.Capsule) else 0.0
    along = half * item.placement.rotation[:, 2]
    return np.array([item.placement.translation - along, item.placement.translation + along])


def _sweep(item: pin.GeometryObject, joints: tuple[FingerJoint, ...]) -> bool:
    """Make a shape what it sweeps; whether all of its segment moves along one line."""
    ways = [[(end - joint.home) * joint.axis for end in (joint.before, joint.beyond)] for joint in joints]
    points = np.array([end + np.sum(move, axis=0) for move in product(*ways) for end in _ends(item)])
    radius, line = float(item.geometry.radius), _line_of(points)
    # A capsule is convex: the one around the corners of what the segment sweeps holds all of it.
    thicker, start, end = enclosing_capsule(points) if line is None else (0.0, *line)
    item.geometry, item.placement = capsule_between(radius + thicker, start, end)
    return line is not None


def _line_of(points: Array) -> Array | None:
    """Both ends of the segment that all ``points`` (n, 3) lie on (2, 3); None where they do not lie on one."""
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
    """Join bodies on one line; returns the fingers of those that are left, None where they move across one."""
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
