"""The bodies of fingers: each is what it sweeps from one end of its joints' travel to the other.

Distances know arm joints only, so a finger's body is all of its way; what of it counts while the gripper's opening is
known says finger_openings.py of those that slide, turning_fingers.py of those that turn.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.robot.description import LinkTree, joint_limits
from q2r2_control.robot.enclose import capsule_between, enclosing_capsule
from q2r2_control.robot.finger_openings import FingerBody, FingerSlide
from q2r2_control.robot.link_roles import KnownParts, links_moved_by
from q2r2_control.robot.locking import joint_axis
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.robot.turning_joints import finger_joint, turns
from q2r2_control.types import ALL_OF_THE_WAY, Array

_ON_ONE_LINE = 1e-9  # [m]


@dataclass(frozen=True, slots=True)
class _Way:
    """What one finger joint moves a link by."""

    direction: Array  # (3,) unit vector
    home: float  # [m]
    lower: float
    upper: float
    stroke: tuple[float, float] | None  # positions of the closed and the open gripper [m], where they are known

    @property
    def ends(self) -> tuple[Array, Array]:
        """From home to both ends (3,) [m]."""
        return (self.lower - self.home) * self.direction, (self.upper - self.home) * self.direction


# Both ends of a shape as it was drawn (2, 3) [m] and what moves them.
_Finger = tuple[Array, list[_Way]]


def sweep_fingers(
    model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree, parts: KnownParts, home: Mapping[str, float]
) -> tuple[FingerBody | TurningBody, ...]:
    """Replace in place the capsules and spheres of fingers, locked at ``home``, by what they sweep.

    Capsules of two fingers of one gripper that slide on one line and are equally thick become one, which keeps the
    first one's name: what is between the fingers is theirs. Returns the bodies of which less counts where the gripper's
    opening is known: those along whose line the fingers slide, and those that turn. A finger that slides across its
    body is all of its way always; one that is moved by a joint of more than one axis stays as it is.
    """
    bodies: list[FingerBody | TurningBody] = []
    for arm, joints in parts.finger_joints.items():
        links, stroke = links_moved_by(tree, joints), parts.strokes.get(arm)
        swept: dict[str, list[_Finger] | None] = {}
        for item in geometry.geometryObjects:
            chain = _chain(tree, link_of(item.name), links)
            if turns(chain):
                turning = tuple(finger_joint(model, tree, joint, home, joints, stroke) for joint in chain)
                body = TurningBody(arm, item.name, _ends(item), float(item.geometry.radius), turning)
                start, end, radius = body.capsule(ALL_OF_THE_WAY)
                item.geometry, item.placement = capsule_between(radius, start, end)
                bodies += [body] if stroke is not None else []
            elif chain and all(joint.get("type") == "prismatic" for joint in chain):
                ways = [_way(model, joint, home, stroke) for joint in chain]
                drawn = _ends(item)
                swept[item.name] = [(drawn, ways)] if _sweep(item, ways) else None
        for name, fingers in _merge(geometry, swept).items():
            sliding = fingers and _body(arm, geometry.geometryObjects[geometry.getGeometryId(name)], fingers)
            if sliding:
                bodies.append(sliding)
    return tuple(bodies)


def _chain(tree: LinkTree, link: str, links: set[str]) -> list[ET.Element]:
    """The finger joints that carry ``link``, from the hand outwards, of a gripper that moves ``links``."""
    if link not in links:
        return []
    moving = {id(joint) for child, joint in tree.joint_to.items() if child in links}
    return [joint for joint in tree.chain(link) if id(joint) in moving]


def _way(model: pin.Model, joint: ET.Element, home: Mapping[str, float], stroke: tuple[float, float] | None) -> _Way:
    name = joint.get("name", "")
    frame = model.frames[model.getFrameId(name, pin.FrameType.FIXED_JOINT)]
    mimic = joint.find("mimic")
    if stroke is not None and mimic is not None:
        multiplier, offset = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
        stroke = multiplier * stroke[0] + offset, multiplier * stroke[1] + offset
    return _Way(frame.placement.rotation @ joint_axis(joint), home.get(name, 0.0), *joint_limits(joint), stroke)


def _body(arm: str, item: pin.GeometryObject, fingers: list[_Finger]) -> FingerBody | None:
    """A swept body as it depends on the opening; None where no opening tells where its fingers are."""
    start, end = _ends(item)
    length = float(np.linalg.norm(end - start))
    if length <= _ON_ONE_LINE or any(way.stroke is None for _, ways in fingers for way in ways):
        return None
    along = (end - start) / length
    ends = [
        (
            float((point - start) @ along),
            tuple(
                FingerSlide(float(way.direction @ along), way.home, *way.stroke, way.lower, way.upper)
                for way in ways
                if way.stroke is not None
            ),
        )
        for drawn, ways in fingers
        for point in drawn
    ]
    return FingerBody(arm, item.name, length, tuple(ends))


def _ends(item: pin.GeometryObject) -> Array:
    """Ends of a capsule's segment, or a sphere's centre twice (2, 3) [m]."""
    half = item.geometry.halfLength if isinstance(item.geometry, coal.Capsule) else 0.0
    along = half * item.placement.rotation[:, 2]
    return np.array([item.placement.translation - along, item.placement.translation + along])


def _sweep(item: pin.GeometryObject, ways: list[_Way]) -> bool:
    """Make a shape what it sweeps; whether all of its segment moves along one line."""
    moves = product(*(way.ends for way in ways))
    points = np.array([end + moved for moved in [np.sum(move, axis=0) for move in moves] for end in _ends(item)])
    radius, line = float(item.geometry.radius), _line_of(points)
    on_one_line = line is not None
    if line is None:
        # A capsule is convex: the one around the corners of what the segment sweeps holds all of it.
        thicker, start, end = enclosing_capsule(points)
        radius, line = radius + thicker, np.array([start, end])
    item.geometry, item.placement = capsule_between(radius, line[0], line[1])
    return on_one_line


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
