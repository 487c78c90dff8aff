"""Which collision pairs are monitored."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.description import LinkTree, joint_end, parse_srdf
from q2r2_control.types import Array

# Links that always stay farther apart than this need no watching: more than twice what is usually kept [m].
CLEARANCE = 0.05

_UPRIGHT = 1e-9  # sine of the angle to the vertical [-]


def link_of(geometry_name: str) -> str:
    """Link of a geometry object: Pinocchio names the objects of a link LINK_0, LINK_1, ..."""
    return geometry_name.rsplit("_", 1)[0]


def add_movable_pairs(model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree) -> None:
    """Add every pair whose bodies can move relative to each other and are not neighbours in the chain.

    Neighbours: bodies with one joint between them, where fixed parts such as a tool belong to the body that carries
    them. What stands fixed in the world is one body for Pinocchio, yet a table is no neighbour of an arm's first
    link: there only the link that carries the joint is.
    """
    geometry.removeAllCollisionPairs()
    for first, second in combinations(range(geometry.ngeoms), 2):
        a, b = (geometry.geometryObjects[index] for index in (first, second))
        if a.parentJoint == b.parentJoint:
            continue
        inner, outer = (a, b) if a.parentJoint < b.parentJoint else (b, a)
        if model.parents[outer.parentJoint] == inner.parentJoint and (
            inner.parentJoint != 0 or _carries(link_of(inner.name), model.names[outer.parentJoint], tree)
        ):
            continue
        geometry.addCollisionPair(pin.CollisionPair(first, second))


def remove_disabled_pairs(geometry: pin.GeometryModel, exclusions: Iterable[ET.Element]) -> None:
    """Remove what an SRDF disables: ``disable_collisions`` of two links, ``disable_default_collisions`` of one."""
    pairs: set[frozenset[str]] = set()
    links: set[str] = set()
    for element in exclusions:
        if element.tag == "disable_collisions":
            pairs.add(frozenset((element.get("link1", ""), element.get("link2", ""))))
        elif element.tag == "disable_default_collisions":
            links.add(element.get("link", ""))
    _keep(
        geometry,
        lambda a, b: frozenset((link_of(a), link_of(b))) not in pairs and not links & {link_of(a), link_of(b)},
    )


def exclusions_of_file(path: str, links: set[str]) -> list[ET.Element]:
    """Pairs that an SRDF of a whole cell disables; all of them have to be among the cell's ``links``.

    Raises :class:`ConfigError`: a link that is not there was meant for another cell.
    """
    file = find_resource(path)
    try:
        found = parse_srdf(file.read_text(encoding="utf-8"), str(file)).findall("disable_collisions")
    except (OSError, UnicodeDecodeError, RobotError) as error:
        raise ConfigError(f"srdf = {path!r:.80}: cannot be read: {error!s:.200}") from error
    for link in (element.get(end, "") for element in found for end in ("link1", "link2")):
        if link not in links:
            raise ConfigError(f"srdf = {path!r:.80}: no link {link!r:.60} in this cell; q2r2 check --pairs writes one")
    return found


def remove_overlapping_own_pairs(
    model: pin.Model, geometry: pin.GeometryModel, own_links: Sequence[set[str]], postures: Sequence[Array]
) -> tuple[tuple[str, str], ...]:
    """Remove pairs of one arm's own links that touch at every one of ``postures``, and return their names.

    For shapes that overlap by construction, such as capsules around neighbouring meshes. ``own_links`` has one set of
    links an arm, from its base to its tool. A pair with the other arm or with an obstacle stays, however it lies.
    """
    data, geometry_data = model.createData(), geometry.createData()
    names = pair_names(geometry)
    within_one_arm = [any({link_of(name) for name in pair} <= links for links in own_links) for pair in names]
    touching = np.array(within_one_arm, dtype=bool)  # of no pair too
    for q in postures:
        pin.computeDistances(model, data, geometry, geometry_data, q)
        touching &= np.array([result.min_distance <= 0 for result in geometry_data.distanceResults], dtype=bool)
    removed = tuple(pair for pair, touches in zip(names, touching, strict=True) if touches)
    _keep(geometry, lambda a, b: (a, b) not in removed)
    return removed


def remove_unreachable_floor_pairs(model: pin.Model, geometry: pin.GeometryModel, floor: str) -> None:
    """Remove pairs of link ``floor``, a horizontal surface, with bodies that cannot come nearer to it than now.

    Two kinds, both proven: bodies that turn about vertical axes only, as an arm's first link does, and stay as high as
    they are; and bodies whose distance from the first joint that can tip them is too short to come within
    :data:`CLEARANCE`.
    """
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    items = {item.name: item for item in geometry.geometryObjects}

    def can_meet(a: str, b: str) -> bool:
        surface, body = items[a], items[b]
        if not _is_level_surface(surface, floor):
            surface, body = body, surface
        if not _is_level_surface(surface, floor):
            return True
        lowest = _lowest(model, data, body)
        top = surface.placement.translation[2] + surface.geometry.halfSide[2]
        return lowest is not None and lowest - top <= CLEARANCE

    _keep(geometry, can_meet)


def _is_level_surface(item: pin.GeometryObject, link: str) -> bool:
    fixed_box = isinstance(item.geometry, coal.Box) and item.parentJoint == 0
    return fixed_box and link_of(item.name) == link and bool(item.placement.rotation[2, 2] > 1.0 - _UPRIGHT)


def _lowest(model: pin.Model, data: pin.Data, item: pin.GeometryObject) -> float | None:
    """Height that no point of a capsule or sphere is ever below [m]; None where no joint raises or lowers it.

    Joints that turn about vertical axes or slide along level ones leave all heights as they are at zero, for which
    ``data`` has frames and Jacobians. So the first other joint's origin keeps its height, and what hangs on that joint
    lies in a ball around it.
    """
    height, world_axes = None, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    reach = float(np.linalg.norm(item.placement.translation)) + item.geometry.radius
    reach += getattr(item.geometry, "halfLength", 0.0)
    for joint in list(model.supports[item.parentJoint])[1:]:
        index = model.joints[joint].idx_v
        twist = pin.getJointJacobian(model, data, joint, world_axes)[:, index]  # of the joint's origin
        slides = np.linalg.norm(twist[:3]) > 0.5
        if height is None:
            if (abs(twist[2]) if slides else np.linalg.norm(twist[3:5])) <= _UPRIGHT:
                continue
            height = float(data.oMi[joint].translation[2])
        else:
            reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
        if slides:
            reach += max(abs(model.lowerPositionLimit[index]), abs(model.upperPositionLimit[index]))
    return None if height is None else height - reach


def pair_names(geometry: pin.GeometryModel) -> tuple[tuple[str, str], ...]:
    """Names of both objects of each pair, in Pinocchio's order."""
    objects = geometry.geometryObjects
    return tuple((objects[pair.first].name, objects[pair.second].name) for pair in geometry.collisionPairs)


def _keep(geometry: pin.GeometryModel, wanted: Callable[[str, str], bool]) -> None:
    pairs = list(geometry.collisionPairs)
    names = pair_names(geometry)
    geometry.removeAllCollisionPairs()
    for pair, (a, b) in zip(pairs, names, strict=True):
        if wanted(a, b):
            geometry.addCollisionPair(pair)


def _carries(link: str, joint: str, tree: LinkTree) -> bool:
    return any(
        element.get("name") == joint and joint_end(element, "parent") == link for element in tree.joint_to.values()
    )
