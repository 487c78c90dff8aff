"""Find the joints and the tip of an arm in a model, if the configuration does not name them.

From the base, the arm follows the movable joints one by one, and ends before the joints of a gripper. Its tip is the
outermost link that is fixed to the last joint. If a model can be read in more than one way, the user has to decide.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.errors import ConfigError
from q2r2_control.robot.description import LinkTree, joint_end
from q2r2_control.robot.pinocchio_models import joint_origin

_GRIPPER_JOINT = re.compile(r"gripper|finger|jaw|thumb|knuckle", re.IGNORECASE)
# A wrist joint that turns the gripper, such as gripper_roll_joint, belongs to the arm.
_WRIST_JOINT = re.compile(r"gripper_?(roll|rotat|twist|yaw|pitch|swivel)", re.IGNORECASE)
# Names of links that are not the tool. Links that are fixed to a side branch are not the tool either, but a link that
# is fixed to a sensor may be the tool.
_SIDE_BRANCH = re.compile(r"finger|jaw|thumb|knuckle|camera|antenna|imu", re.IGNORECASE)
_SENSOR = re.compile(r"sensor|accelerometer|_range", re.IGNORECASE)
# Patterns for the names of tool frames, in the order in which they are tried.
_TOOL_FRAMES = [
    re.compile(pattern, re.IGNORECASE)
    for pattern in (r"tcp", r"tool", r"(^|_)eef?(_|$)|end_?effector|endpoint", r"grasp|gripper_?frame", r"flange")
]
_SAME_PLACE = 1e-3  # Largest distance between the origins of links that count as being at the same position [m].
_LEAST_JOINTS = 4  # Least number of joints of an arm. Chains of wheels and heads have fewer.


def default_tip(tree: LinkTree, gripper_joints: Collection[str], key: str) -> str:
    """Return the link at the end of the only chain of movable joints in ``tree``.

    Raises:
        ConfigError: With a text that begins with ``key`` and names the candidates, if there are several chains.
    """
    link = tree.root
    while onwards := _onwards(tree, link, gripper_joints):
        if len(onwards) > 1:
            names = ", ".join(joint.get("name", "") for joint in onwards)
            raise ConfigError(f"{key}: the model's chain branches at {link} into {names}: name the arm's last link")
        link = joint_end(onwards[0], "child")
    return end_of(tree, link, key)


def arm_ends(tree: LinkTree) -> list[str]:
    """Return the last link of each chain that is long enough for an arm."""
    ends, links = [], [tree.root]
    for link in links:  # The loop also visits the links that it adds to the list.
        onwards = [joint_end(joint, "child") for joint in _onwards(tree, link, ())]
        links += onwards
        ends += [link] if not onwards and len(tree.chain(link)) >= _LEAST_JOINTS else []
    return ends


def _onwards(tree: LinkTree, link: str, gripper_joints: Collection[str]) -> list[ET.Element]:
    """Return the joints that continue the chain from the links fixed to ``link``; [] if these joints move fingers."""
    body, depth = tree.fixed_to(link), len(tree.chain(link))
    onwards = [
        joint
        for name, joint in tree.movable().items()
        if joint_end(joint, "parent") in body and name not in gripper_joints and not _is_gripper_joint(tree, joint)
    ]
    if len(onwards) > 1:
        ends = {joint_end(joint, "child") for joint in onwards}
        longest = max(len(tree.chain(end)) - depth for end in tree.joint_to if ends & set(tree.path(end)))
        if depth >= longest > 0:
            return []  # These joints move the fingers of a gripper.
    return onwards


def end_of(tree: LinkTree, link: str, key: str) -> str:
    """Return the outermost link that is fixed to ``link``. Side branches such as cameras do not count.

    Raises:
        ConfigError: With a text that begins with ``key``, if more than one link could be the end.
    """

    def is_side_branch(end: str) -> bool:
        # A fixed joint with a <mimic> belongs to a gripper that is not used, so it begins a side branch.
        beyond = tree.path(end)[len(tree.path(link)) :]
        return any(_SIDE_BRANCH.search(name) or tree.joint_to[name].find("mimic") is not None for name in beyond)

    body = [name for name in tree.fixed_to(link) if not is_side_branch(name)]
    carriers = {joint_end(tree.joint_to[name], "parent") for name in body if name != link}
    ends = [name for name in body if name not in carriers]
    ends = [name for name in ends if not _SENSOR.search(name)] or ends
    for pattern in _TOOL_FRAMES:
        if named := [name for name in ends if pattern.search(name)]:
            ends = named
            break
    places = [_place_in(tree, link, name) for name in ends]
    if any(np.linalg.norm(place - places[0]) > _SAME_PLACE for place in places):
        raise ConfigError(f"{key}: the arm could end at {', '.join(ends)}: name the link that is meant")
    return ends[0]


def named_joints(tree: LinkTree, tip: str, names: Sequence[str], key: str) -> list[ET.Element]:
    """Return the joints ``names`` of the chain to ``tip``, or all joints of the chain if no names are given.

    Raises:
        ConfigError: If they are not movable joints of this chain, in the order from base to tip.
    """
    chain = tree.chain(tip)
    order = [joint.get("name", "") for joint in chain]
    for name in names:
        if name not in order:
            allowed = ", ".join(order) or "none"
            raise ConfigError(f"{key}.joints = {name!r:.60}: no movable joint that carries {tip}; allowed: {allowed}")
    if sorted(names, key=order.index) != list(names) or len(set(names)) < len(names):
        wanted = ", ".join(name for name in order if name in names)
        raise ConfigError(f"{key}.joints = {', '.join(names):.200}: expected from base to tip, once each: {wanted}")
    return [joint for joint in chain if not names or joint.get("name") in names]


def _is_gripper_joint(tree: LinkTree, joint: ET.Element) -> bool:
    name = joint.get("name", "")
    mimicked = any(found.get("joint") == name for other in tree.joint_to.values() for found in other.findall("mimic"))
    if mimicked or joint.find("mimic") is not None:
        return True
    return _GRIPPER_JOINT.search(name) is not None and _WRIST_JOINT.search(name) is None


def _place_in(tree: LinkTree, link: str, end: str) -> np.ndarray:
    """Return the origin of ``end`` in the frame of ``link``, to which it is fixed [m]."""
    place = pin.SE3.Identity()
    for name in tree.path(end)[len(tree.path(link)) :]:
        place = place * joint_origin(tree.joint_to[name])
    return np.asarray(place.translation)
