"""The bodies of fingers that slide: each is what it sweeps from one end of its joint's travel to the other.

Distances know arm joints only. A finger may be anywhere on its way while a stop is certified, so its body is all of
that way. Fingers that turn stay as they are at home, open.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from itertools import product

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.robot.description import LinkTree, joint_limits
from q2r2_control.robot.enclose import capsule_between, enclosing_capsule
from q2r2_control.robot.link_roles import KnownParts, links_moved_by
from q2r2_control.robot.locking import joint_axis
from q2r2_control.robot.pairs import link_of
from q2r2_control.types import Array

_ON_ONE_LINE = 1e-9  # [m]


def sweep_fingers(
    model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree, parts: KnownParts, home: Mapping[str, float]
) -> None:
    """Replace in place the capsules and spheres of sliding fingers, locked at ``home``, by what they sweep.

    Capsules of two fingers of one gripper that lie on one line and are equally thick become one, which keeps the first
    one's name: what is between the fingers is theirs.
    """
    for joints in parts.finger_joints.values():
        links = links_moved_by(tree, joints)
        swept = [item for item in geometry.geometryObjects if link_of(item.name) in links]
        for item in swept:
            ways = _ways(model, tree, link_of(item.name), links, home)
            if ways:
                _sweep(item, ways)
        _merge(geometry, [item.name for item in swept])


def _ways(
    model: pin.Model, tree: LinkTree, link: str, links: set[str], home: Mapping[str, float]
) -> list[tuple[Array, Array]]:
    """For each finger joint that carries ``link`` both ends of what it moves it by [m]; none where one turns."""
    ways = []
    for joint in tree.chain(link):
        child = next(name for name, carrier in tree.joint_to.items() if carrier is joint)
        if child not in links:
            continue
        if joint.get("type") != "prismatic":
            return []
        ways.append(_way(model, joint, home))
    return ways


def _way(model: pin.Model, joint: ET.Element, home: Mapping[str, float]) -> tuple[Array, Array]:
    name = joint.get("name", "")
    frame = model.frames[model.getFrameId(name, pin.FrameType.FIXED_JOINT)]
    direction = frame.placement.rotation @ joint_axis(joint)
    lower, upper = (limit - home.get(name, 0.0) for limit in joint_limits(joint))
    return lower * direction, upper * direction


def _ends(item: pin.GeometryObject) -> Array:
    """Ends of a capsule's segment, or a sphere's centre twice (2, 3) [m]."""
    half = item.geometry.halfLength if isinstance(item.geometry, coal.Capsule) else 0.0
    along = half * item.placement.rotation[:, 2]
    return np.array([item.placement.translation - along, item.placement.translation + along])


def _sweep(item: pin.GeometryObject, ways: list[tuple[Array, Array]]) -> None:
    points = np.array([end + np.sum(moved, axis=0) for end in _ends(item) for moved in product(*ways)])
    radius, line = float(item.geometry.radius), _line_of(points)
    if line is None:
        # A capsule is convex: the one around the corners of what the segment sweeps holds all of it.
        thicker, start, end = enclosing_capsule(points)
        radius, line = radius + thicker, np.array([start, end])
    item.geometry, item.placement = capsule_between(radius, line[0], line[1])


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


def _merge(geometry: pin.GeometryModel, names: list[str]) -> None:
    kept: list[pin.GeometryObject] = []
    for name in names:
        item = geometry.geometryObjects[geometry.getGeometryId(name)]
        for other in kept:
            line = _line_of(np.concatenate([_ends(other), _ends(item)]))
            if line is not None and abs(other.geometry.radius - item.geometry.radius) <= _ON_ONE_LINE:
                other.geometry, other.placement = capsule_between(float(other.geometry.radius), line[0], line[1])
                geometry.removeGeometryObject(name)
                break
        else:
            kept.append(item)
