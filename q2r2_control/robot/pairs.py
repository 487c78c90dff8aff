"""Choose which collision pairs are monitored, and find the roles of links, on which this choice depends."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import combinations

import numpy as np
import pinocchio as pin

from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.description import LinkTree, joint_end, parse_srdf, read_xml
from q2r2_control.robot.followers import followers_of
from q2r2_control.types import Array


class LinkClass(StrEnum):
    """The class of a link, as ``control.distances`` names it. The outermost class comes first."""

    OBJECT = "object"
    FINGER = "finger"
    TOOL = "tool"
    ARM = "arm"
    OBSTACLE = "obstacle"


@dataclass(frozen=True, slots=True)
class KnownParts:
    """Facts about links that a URDF alone does not tell. Links and joints have their names in the URDF."""

    finger_joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # Joints of the fingers, by arm.
    tool_links: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # Links of the tool, by arm.
    obstacles: tuple[str, ...] = ()  # Links that are obstacles.
    # Positions of the finger joints with the gripper closed and open [m or rad], by arm.
    strokes: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    # Greatest number of capsules for each mesh, by link. The default is one.
    capsules: Mapping[str, int] = field(default_factory=dict)
    # Links beside an arm that follow the arm, such as a bar of a parallelogram. The value is the joint that it follows.
    following: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def carried_by(cls, tree: LinkTree, chains: Mapping[str, Sequence[str]]) -> KnownParts:
        """Return the facts that the tree shows. Joints beyond an arm's own joints count as joints of its fingers.

        ``chains`` are the joints of each arm, from base to tool.
        """
        of_arms = {joint for chain in chains.values() for joint in chain}
        last = {arm: joint_end(tree.movable()[chain[-1]], "child") for arm, chain in chains.items()}
        fingers = {
            arm: tuple(
                name
                for name, joint in tree.movable().items()
                if name not in of_arms and link in tree.path(joint_end(joint, "parent"))
            )
            for arm, link in last.items()
        }
        hands = {arm: tuple(sorted(hand_links(tree, joints))) for arm, joints in fingers.items()}
        return cls(fingers, hands, following=links_that_follow(tree, of_arms))


@dataclass(frozen=True, slots=True)
class Role:
    """The class of one link, and the arms to which it belongs.

    A link of a torso may belong to several arms, or to none.
    """

    part: LinkClass
    arms: frozenset[str]


def roles_of(tree: LinkTree, own_links: Mapping[str, set[str]], parts: KnownParts) -> dict[str, Role]:
    """Return the role of every link. ``own_links`` are the links of each arm, from the root to the fingers."""
    classes = dict.fromkeys([tree.root, *tree.joint_to], LinkClass.ARM)
    classes |= dict.fromkeys(parts.obstacles, LinkClass.OBSTACLE)
    for links in parts.tool_links.values():
        classes |= dict.fromkeys(links, LinkClass.TOOL)
    for joints in parts.finger_joints.values():
        classes |= dict.fromkeys(links_moved_by(tree, joints), LinkClass.FINGER)
    return {
        link: Role(part, frozenset(arm for arm, links in own_links.items() if link in links))
        for link, part in classes.items()
    }


def links_moved_by(tree: LinkTree, joints: Iterable[str]) -> set[str]:
    """Return the links that are moved by ``joints``, or by joints that follow one of them."""
    named = set(joints)
    followers = followers_of(tree.joint_to.values(), driven=named)
    named |= {name for name, one in followers.items() if one.driver in named}
    moved = {child for child, joint in tree.joint_to.items() if joint.get("name") in named}
    return {link for link in tree.joint_to if moved & set(tree.path(link))}


def links_that_follow(tree: LinkTree, joints: Collection[str]) -> dict[str, str]:
    """Return the links beside an arm that follow it, such as the bars of a parallelogram.

    The value is the joint that the link follows, which is one of ``joints``.
    """
    followers = followers_of(tree.joint_to.values(), driven=joints)
    beside = {name: one.driver for name, one in followers.items() if one.driver in joints}
    return {link: driver for name, driver in beside.items() for link in sorted(links_moved_by(tree, [name]))}


def hand_links(tree: LinkTree, finger_joints: Iterable[str]) -> set[str]:
    """Return the links of the hand of an arm without a tool model.

    These are the links to which ``finger_joints`` are attached, and all links beyond them.
    """
    named = set(finger_joints)
    palms = {joint_end(joint, "parent") for joint in tree.joint_to.values() if joint.get("name") in named}
    return {link for link in tree.joint_to if palms & set(tree.path(link))}


# Links that always stay farther apart than this distance [m] need no watching. The distance is more than twice as large
# as the distance that pairs usually keep.
CLEARANCE = 0.05
# Links and shapes whose names end with this text represent a whole tool at every opening. Their distances are watched,
# but they have no contacts in the simulation.
ENVELOPE = "_envelope"


def link_of(geometry_name: str) -> str:
    """Return the link of a geometry object. Pinocchio names the objects of a link LINK_0, LINK_1, ..."""
    return geometry_name.rsplit("_", 1)[0]


def pairs_with_others(pairs: Iterable[tuple[str, str]], roles: Mapping[str, Role], arm: str) -> np.ndarray:
    """Return the indices (p,) of those ``pairs`` of geometries in which exactly one body belongs to ``arm``.

    ``pairs`` are pairs of names of geometries.
    """
    own = [[arm in roles[link_of(name)].arms for name in names].count(True) for names in pairs]
    return np.flatnonzero(np.array(own, dtype=np.int64) == 1)


def add_movable_pairs(model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree) -> None:
    """Add every pair whose bodies can move relative to each other and are not neighbours in the chain.

    Neighbours are bodies with one joint between them. A fixed part such as a tool belongs to the body to which it is
    fixed. For Pinocchio everything that is fixed in the world is one body, although a table is no neighbour of an arm's
    first link. Of the links that are fixed in the world, only the link to which the joint is attached counts as a
    neighbour.
    """
    carrier = {joint.get("name", ""): joint_end(joint, "parent") for joint in tree.joint_to.values()}
    geometry.removeAllCollisionPairs()
    bodies = [(int(item.parentJoint), link_of(item.name)) for item in geometry.geometryObjects]
    names, parents = list(model.names), list(model.parents)
    for (first, a), (second, b) in combinations(enumerate(bodies), 2):
        if a[0] == b[0]:
            continue
        (inner, link), (outer, _) = (a, b) if a[0] < b[0] else (b, a)
        carries = inner != 0 or carrier.get(names[outer]) == link
        if not (parents[outer] == inner and carries):
            geometry.addCollisionPair(pin.CollisionPair(first, second))


def remove_disabled_pairs(geometry: pin.GeometryModel, exclusions: Iterable[ET.Element]) -> None:
    """Remove the pairs that an SRDF disables.

    ``disable_collisions`` names two links, and ``disable_default_collisions`` names one link.
    """
    pairs: set[frozenset[str]] = set()
    links: set[str] = set()
    for element in exclusions:
        if element.tag == "disable_collisions":
            pairs.add(frozenset((element.get("link1", ""), element.get("link2", ""))))
        elif element.tag == "disable_default_collisions":
            links.add(element.get("link", ""))
    keep_pairs(
        geometry,
        lambda a, b: frozenset((link_of(a), link_of(b))) not in pairs and not links & {link_of(a), link_of(b)},
    )


def exclusions_of_file(path: str, links: set[str]) -> list[ET.Element]:
    """Return the pairs that an SRDF of a whole cell disables.

    Raises:
        ConfigError: If the file cannot be read, or if it names a link that is not among the cell's ``links``. Such a
            file was probably meant for another cell.
    """
    file = find_resource(path)
    try:
        found = parse_srdf(read_xml(file), str(file)).findall("disable_collisions")
    except RobotError as error:
        raise ConfigError(f"srdf = {path!r:.80}: {error!s:.200}") from error
    for link in (element.get(end, "") for element in found for end in ("link1", "link2")):
        if link not in links:
            raise ConfigError(f"srdf = {path!r:.80}: no link {link!r:.60} in this cell; q2r2 check --pairs writes one")
    return found


def remove_overlapping_own_pairs(
    model: pin.Model, geometry: pin.GeometryModel, own_links: Sequence[set[str]], postures: Sequence[Array]
) -> tuple[tuple[str, str], ...]:
    """Remove pairs of one arm's own links that touch at every one of ``postures``, and return their names.

    Such shapes overlap by construction. ``own_links`` has one set of links for each arm, from its base to its tool. A
    pair with the other arm or with an obstacle always stays.
    """
    touching = geometry.copy()
    keep_pairs(touching, lambda a, b: any({link_of(a), link_of(b)} <= links for links in own_links))
    distances = CoalDistances(model, touching)
    for q in postures:
        apart = np.flatnonzero(~(distances.at(q) <= 0.0))
        if len(apart):  # At all other postures, only the few pairs that are left have to be measured.
            names = pair_names(touching)
            keep_pairs(touching, _not_among({names[pair] for pair in apart}))
            distances = CoalDistances(model, touching)
    removed = pair_names(touching)
    keep_pairs(geometry, _not_among(removed))
    return removed


def _not_among(pairs: Collection[tuple[str, str]]) -> Callable[[str, str], bool]:
    return lambda a, b: (a, b) not in pairs


def pair_names(geometry: pin.GeometryModel) -> tuple[tuple[str, str], ...]:
    """Return the names of both objects of each pair, in Pinocchio's order."""
    # This list is made once, because looking up each name again would take longer.
    names = [item.name for item in geometry.geometryObjects]
    return tuple((names[pair.first], names[pair.second]) for pair in geometry.collisionPairs)


def keep_pairs(geometry: pin.GeometryModel, wanted: Callable[[str, str], bool]) -> None:
    """Remove every pair for whose two names ``wanted`` returns False."""
    pairs = list(geometry.collisionPairs)
    names = pair_names(geometry)
    geometry.removeAllCollisionPairs()
    for pair, (a, b) in zip(pairs, names, strict=True):
        if wanted(a, b):
            geometry.addCollisionPair(pair)


def distance_gradient(
    model: pin.Model, data: pin.Data, geometries: pin.GeometryModel, geometry_data: pin.GeometryData, pair: int
) -> Array:
    """Return the gradient of a pair's distance with respect to the joints (nv,) [m/rad].

    It is the normal times the difference of the Jacobians of both nearest points. ``data`` has to contain the joint
    Jacobians, and ``geometry_data`` the placements of the geometry and the distance of the pair.
    """
    result, bodies = geometry_data.distanceResults[pair], geometries.collisionPairs[pair]
    points = result.getNearestPoint1(), result.getNearestPoint2()
    normal = points[1] - points[0]
    normal = normal / max(float(np.linalg.norm(normal)), 1e-12) * (1.0 if result.min_distance >= 0.0 else -1.0)
    gradient = np.zeros(model.nv)
    for side, body, point in ((-1.0, bodies.first, points[0]), (1.0, bodies.second, points[1])):
        joint = geometries.geometryObjects[body].parentJoint
        jacobian = pin.getJointJacobian(model, data, joint, pin.LOCAL_WORLD_ALIGNED)
        lever = point - data.oMi[joint].translation
        gradient += side * normal @ (jacobian[:3] - pin.skew(lever) @ jacobian[3:])
    return gradient
