"""Which collision pairs are monitored, and the roles of links that decide it."""

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
from q2r2_control.robot.description import LinkTree, joint_end, parse_srdf
from q2r2_control.robot.followers import followers_of
from q2r2_control.types import Array


class LinkClass(StrEnum):
    """A link's class, as in ``control.distances``, the outermost first."""

    OBJECT = "object"
    FINGER = "finger"
    TOOL = "tool"
    ARM = "arm"
    OBSTACLE = "obstacle"


@dataclass(frozen=True, slots=True)
class KnownParts:
    """Facts about links that a URDF alone does not tell. By arm; names as in the URDF."""

    finger_joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    tool_links: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    obstacles: tuple[str, ...] = ()  # links
    strokes: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # finger joints closed and open [m or rad]
    capsules: Mapping[str, int] = field(default_factory=dict)  # of each mesh, at most, by link; else one
    following: Mapping[str, str] = field(default_factory=dict)  # joint of an arm that a link beside it follows, by link

    @classmethod
    def carried_by(cls, tree: LinkTree, chains: Mapping[str, Sequence[str]]) -> KnownParts:
        """Roles that the tree shows, ``chains`` being each arm's joints: those that it carries move its fingers."""
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
    """One link. A robot's body may carry several arms, or none."""

    part: LinkClass
    arms: frozenset[str]


def roles_of(tree: LinkTree, own_links: Mapping[str, set[str]], parts: KnownParts) -> dict[str, Role]:
    """The role of every link; ``own_links`` are those of each arm, from the root to whatever its joints carry."""
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
    """Links that ``joints``, or joints that follow one of them, carry."""
    named = set(joints)
    followers = followers_of(tree.joint_to.values(), driven=named)
    named |= {name for name, one in followers.items() if one.driver in named}
    moved = {child for child, joint in tree.joint_to.items() if joint.get("name") in named}
    return {link for link in tree.joint_to if moved & set(tree.path(link))}


def links_that_follow(tree: LinkTree, joints: Collection[str]) -> dict[str, str]:
    """Links of parts beside an arm, such as the bars of a parallelogram, each with the one of ``joints`` it follows."""
    followers = followers_of(tree.joint_to.values(), driven=joints)
    beside = {name: one.driver for name, one in followers.items() if one.driver in joints}
    return {link: driver for name, driver in beside.items() for link in sorted(links_moved_by(tree, [name]))}


def hand_links(tree: LinkTree, finger_joints: Iterable[str]) -> set[str]:
    """Links that carry ``finger_joints``, and all that hangs on these: the hand of an arm that has no tool model."""
    named = set(finger_joints)
    palms = {joint_end(joint, "parent") for joint in tree.joint_to.values() if joint.get("name") in named}
    return {link for link in tree.joint_to if palms & set(tree.path(link))}


# Links that always stay farther apart than this need no watching: more than twice what is usually kept [m].
CLEARANCE = 0.05
# Links and shapes of this name ending stand for a whole tool at every opening: watched from afar, never touched.
ENVELOPE = "_envelope"


def link_of(geometry_name: str) -> str:
    """Link of a geometry object: Pinocchio names the objects of a link LINK_0, LINK_1, ..."""
    return geometry_name.rsplit("_", 1)[0]


def pairs_with_others(pairs: Iterable[tuple[str, str]], roles: Mapping[str, Role], arm: str) -> np.ndarray:
    """Numbers (p,) of those ``pairs`` of geometry names that are of a part of ``arm`` and of something else."""
    own = [[arm in roles[link_of(name)].arms for name in names].count(True) for names in pairs]
    return np.flatnonzero(np.array(own, dtype=np.int64) == 1)


def add_movable_pairs(model: pin.Model, geometry: pin.GeometryModel, tree: LinkTree) -> None:
    """Add every pair whose bodies can move relative to each other and are not neighbours in the chain.

    Neighbours: bodies with one joint between them, where fixed parts such as a tool belong to the body that carries
    them. Everything fixed in the world is one body for Pinocchio, yet a table is no neighbour of an arm's first link.
    There only the link that carries the joint is.
    """
    carrier = {joint.get("name", ""): joint_end(joint, "parent") for joint in tree.joint_to.values()}
    geometry.removeAllCollisionPairs()
    for first, second in combinations(range(geometry.ngeoms), 2):
        a, b = (geometry.geometryObjects[index] for index in (first, second))
        if a.parentJoint == b.parentJoint:
            continue
        inner, outer = (a, b) if a.parentJoint < b.parentJoint else (b, a)
        carries = inner.parentJoint != 0 or carrier.get(model.names[outer.parentJoint]) == link_of(inner.name)
        if not (model.parents[outer.parentJoint] == inner.parentJoint and carries):
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
    keep_pairs(
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

    Such shapes overlap by construction. ``own_links`` has one set of links an arm, from its base to its tool. A pair
    with the other arm or with an obstacle stays, however it lies.
    """
    distances = CoalDistances(model, geometry)
    names = pair_names(geometry)
    within_one_arm = [any(set(map(link_of, pair)) <= links for links in own_links) for pair in names]
    touching = np.array(within_one_arm, dtype=bool)
    for q in postures:
        touching &= distances.at(q) <= 0.0
    removed = tuple(pair for pair, touches in zip(names, touching, strict=True) if touches)
    keep_pairs(geometry, lambda a, b: (a, b) not in removed)
    return removed


def pair_names(geometry: pin.GeometryModel) -> tuple[tuple[str, str], ...]:
    """Names of both objects of each pair, in Pinocchio's order."""
    objects = geometry.geometryObjects
    return tuple((objects[pair.first].name, objects[pair.second].name) for pair in geometry.collisionPairs)


def keep_pairs(geometry: pin.GeometryModel, wanted: Callable[[str, str], bool]) -> None:
    """Remove every pair but those whose two names are ``wanted``."""
    pairs = list(geometry.collisionPairs)
    names = pair_names(geometry)
    geometry.removeAllCollisionPairs()
    for pair, (a, b) in zip(pairs, names, strict=True):
        if wanted(a, b):
            geometry.addCollisionPair(pair)


def distance_gradient(
    model: pin.Model, data: pin.Data, geometries: pin.GeometryModel, geometry_data: pin.GeometryData, pair: int
) -> Array:
    """(nv,) of a pair's distance with respect to the joints [m/rad]: its normal times what moves its nearest points.

    Joint Jacobians, geometry placements and the pair's distance are those that the data hold.
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
