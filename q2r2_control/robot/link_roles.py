"""What each link of a cell is: part of which arm, its tool or a finger, or an obstacle."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from q2r2_control.robot.description import LinkTree, joint_end


class LinkClass(StrEnum):
    """What a link is, in the words of ``control.distances``, the outermost first."""

    OBJECT = "object"
    FINGER = "finger"
    TOOL = "tool"
    ARM = "arm"
    OBSTACLE = "obstacle"


@dataclass(frozen=True, slots=True)
class KnownParts:
    """What a URDF alone does not say of its links. By arm; names as in the URDF."""

    finger_joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    tool_links: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    obstacles: tuple[str, ...] = ()  # links
    strokes: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # finger joints closed and open [m or rad]

    @classmethod
    def carried_by(cls, tree: LinkTree, chains: Mapping[str, Sequence[str]]) -> KnownParts:
        """What the tree alone shows, ``chains`` being each arm's joints: those that it carries move its fingers."""
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
        return cls(fingers, {arm: tuple(sorted(hand_links(tree, joints))) for arm, joints in fingers.items()})


@dataclass(frozen=True, slots=True)
class Role:
    """One link. A robot's body may carry several arms, or none."""

    part: LinkClass
    arms: frozenset[str]


def roles_of(tree: LinkTree, own_links: Mapping[str, set[str]], parts: KnownParts) -> dict[str, Role]:
    """The role of every link; ``own_links`` are those of each arm, from the root to whatever its joints carry."""
    fingers = {link for joints in parts.finger_joints.values() for link in links_moved_by(tree, joints)}
    tools = {link for links in parts.tool_links.values() for link in links}
    obstacles = set(parts.obstacles)

    def part_of(link: str) -> LinkClass:
        if link in fingers:
            return LinkClass.FINGER
        if link in tools:
            return LinkClass.TOOL
        return LinkClass.OBSTACLE if link in obstacles else LinkClass.ARM

    return {
        link: Role(part_of(link), frozenset(arm for arm, links in own_links.items() if link in links))
        for link in [tree.root, *tree.joint_to]
    }


def links_moved_by(tree: LinkTree, joints: Iterable[str]) -> set[str]:
    """Links that ``joints``, or joints that mimic one of them, carry."""
    named = set(joints)
    moved = {child for child, joint in tree.joint_to.items() if joint.get("name") in named or _leader(joint) in named}
    return {link for link in tree.joint_to if moved & set(tree.path(link))}


def hand_links(tree: LinkTree, finger_joints: Iterable[str]) -> set[str]:
    """Links that carry ``finger_joints``, and all that hangs on these: the hand of an arm that has no tool model."""
    named = set(finger_joints)
    palms = {joint_end(joint, "parent") for joint in tree.joint_to.values() if joint.get("name") in named}
    return {link for link in tree.joint_to if palms & set(tree.path(link))}


def _leader(joint: ET.Element) -> str | None:
    mimic = joint.find("mimic")
    return None if mimic is None else mimic.get("joint")
