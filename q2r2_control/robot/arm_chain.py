"""Find the joints and the tip of an arm in a model, if the configuration does not name them.

From the base, the arm follows the movable joints one by one, and ends before the joints of a gripper. Its tip is the
outermost link that is fixed to the last joint. If a model can be read in more than one way, the user has to decide.

A bar that follows a joint of the arm by a <mimic>, as in a parallelogram, is beside the arm and ends no chain. Whether
the last joint moves a jaw is told by the shapes, if the caller measures them, and else by the joint's name.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.errors import ConfigError
from q2r2_control.robot.description import LinkTree, joint_end
from q2r2_control.robot.finger_motion import FingerMotion
from q2r2_control.robot.followers import followers_of
from q2r2_control.robot.pinocchio_models import joint_origin

_GRIPPER_JOINT = re.compile(r"gripper|finger|jaw|thumb|knuckle", re.IGNORECASE)
# A wrist joint that turns the gripper, such as gripper_roll_joint, belongs to the arm.
_WRIST_JOINT = re.compile(r"gripper_?(roll|rotat|twist|yaw|pitch|swivel)", re.IGNORECASE)
# Names of links that are not the tool. A sensor may carry the tool.
_SIDE_BRANCH = re.compile(r"finger|jaw|thumb|knuckle|camera|antenna|imu", re.IGNORECASE)
_SENSOR = re.compile(r"sensor|accelerometer|_range", re.IGNORECASE)
# Names of tool frames. The first one that exists is taken.
_TOOL_FRAMES = [
    re.compile(pattern, re.IGNORECASE)
    for pattern in (r"tcp", r"tool", r"(^|_)eef?(_|$)|end_?effector|endpoint", r"grasp|gripper_?frame", r"flange")
]
_SAME_PLACE = 1e-3  # [m]
_LEAST_JOINTS = 4  # Least number of joints of an arm. Chains of wheels and heads have fewer.
_BEFORE_JAW = 3  # Least number of joints before a jaw. Shapes beside shorter chains are not looked at.


def default_tip(tree: LinkTree, gripper_joints: Collection[str], key: str, motion: FingerMotion | None = None) -> str:
    """Return the link at the end of the only chain of movable joints in ``tree``.

    Args:
        tree: The links and joints of the model.
        gripper_joints: Joints that are known to be a gripper's.
        key: Begins the text of an error.
        motion: Tells jaws by their shapes; if it is None, or has no shapes, names tell.

    Raises:
        ConfigError: With a text that begins with ``key`` and names the candidates, if there are several chains.
    """
    link = tree.root
    while onwards := _onwards(tree, link, gripper_joints, motion):
        if len(onwards) > 1:
            names = ", ".join(joint.get("name", "") for joint in onwards)
            raise ConfigError(f"{key}: the model's chain branches at {link} into {names}: name the arm's last link")
        link = joint_end(onwards[0], "child")
    return end_of(tree, link, key)


def arm_ends(tree: LinkTree, motion: FingerMotion | None = None) -> list[str]:
    """Return the last link of each chain that is long enough for an arm; ``motion`` as in :func:`default_tip`."""
    ends, links = [], [tree.root]
    for link in links:  # The list grows in the loop.
        onwards = [joint_end(joint, "child") for joint in _onwards(tree, link, (), motion)]
        links += onwards
        ends += [link] if not onwards and len(tree.chain(link)) >= _LEAST_JOINTS else []
    return ends


def coupled_joint(tree: LinkTree, tip: str) -> tuple[str, str] | None:
    """Return a joint beyond ``tip`` that carries more of the arm but follows a joint of its chain, and the latter.

    Such a joint has no motor, so that the arm ends before it. None if there is no such joint.
    """
    chain, followers = tree.chain(tip), followers_of(tree.joint_to.values())
    body = tree.fixed_to(tree.root if not chain else joint_end(chain[-1], "child"))
    before = {joint.get("name", "") for joint in chain}
    for name, joint in tree.movable().items():
        leads = followers[name].driver if name in followers else ""
        if leads in before and joint_end(joint, "parent") in body and _independent_beyond(tree, joint, followers):
            return name, leads
    return None


def _onwards(
    tree: LinkTree, link: str, gripper_joints: Collection[str], motion: FingerMotion | None
) -> list[ET.Element]:
    """Return the joints that continue the chain from the links fixed to ``link``; none if a hand begins there."""
    body, depth, followers = tree.fixed_to(link), len(tree.chain(link)), followers_of(tree.joint_to.values())
    motion = motion if depth >= _BEFORE_JAW else None
    carried = [
        joint
        for name, joint in tree.movable().items()
        if joint_end(joint, "parent") in body and name not in gripper_joints and name not in followers
    ]
    arms = [
        joint
        for joint in carried
        if not _leads_fingers(tree, joint, depth, followers, motion)
        and not (motion is None and is_called_gripper(joint.get("name", "")))
    ]
    if arms and len(carried) > 1:
        ends = {joint_end(joint, "child") for joint in arms}
        longest = max(len(tree.chain(end)) - depth for end in tree.joint_to if ends & set(tree.path(end)))
        if depth >= longest > 0:
            return []  # These are the fingers of a hand.
    return [joint for joint in arms if motion is None or not _is_jaw(tree, joint, followers, motion)]


def _leads_fingers(
    tree: LinkTree,
    joint: ET.Element,
    depth: int,
    followers: Collection[str],
    motion: FingerMotion | None,
) -> bool:
    """Return whether others mimic ``joint`` as fingers do, and not as the bars beside an arm.

    An arm goes on beyond such a joint: with more joints than there are before it, or with an end that is no jaw.
    """
    name = joint.get("name")
    if not any(found.get("joint") == name for other in tree.joint_to.values() for found in other.findall("mimic")):
        return False
    beyond = _independent_beyond(tree, joint, followers)
    return len(beyond) + 1 <= depth and not (beyond and motion is not None and motion.is_jaw(beyond[-1]) is False)


def _is_jaw(tree: LinkTree, joint: ET.Element, followers: Collection[str], motion: FingerMotion) -> bool:
    """Return whether shapes show that ``joint`` moves a jaw, or its name says so and they leave a doubt."""
    is_called = is_called_gripper(joint.get("name", ""))
    if _independent_beyond(tree, joint, followers) and not is_called:
        return False  # It carries more than a jaw.
    verdict = motion.is_jaw(joint.get("name", ""))
    return is_called if verdict is None else verdict


def _independent_beyond(tree: LinkTree, joint: ET.Element, followers: Collection[str]) -> list[str]:
    """Return the joints that ``joint`` carries and that follow no other, from the inner to the outer ones."""
    child = joint_end(joint, "child")
    beyond = [
        (len(tree.path(joint_end(other, "parent"))), name)
        for name, other in tree.movable().items()
        if name not in followers and child in tree.path(joint_end(other, "parent"))
    ]
    return [name for _, name in sorted(beyond, key=lambda one: one[0])]


def end_of(tree: LinkTree, link: str, key: str) -> str:
    """Return the outermost link that is fixed to ``link``. Side branches such as cameras do not count.

    Raises:
        ConfigError: With a text that begins with ``key``, if several links could be meant.
    """

    def is_side_branch(end: str) -> bool:
        # A fixed joint with a <mimic> belongs to a gripper that is not used.
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


def is_called_gripper(name: str) -> bool:
    """Return whether a joint has the name of a gripper's, and not of a wrist that turns one."""
    return _GRIPPER_JOINT.search(name) is not None and _WRIST_JOINT.search(name) is None


def _place_in(tree: LinkTree, link: str, end: str) -> np.ndarray:
    """Return the origin of ``end`` in the frame of ``link``, to which it is fixed [m]."""
    place = pin.SE3.Identity()
    for name in tree.path(end)[len(tree.path(link)) :]:
        place = place * joint_origin(tree.joint_to[name])
    return np.asarray(place.translation)
