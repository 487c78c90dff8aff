"""Fingers that turn, as their URDF describes them: which joints move a shape, and what of the gripper drives each."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.robot.description import LinkTree, joint_limits
from q2r2_control.robot.locking import joint_axis
from q2r2_control.robot.turning_fingers import FingerJoint
from q2r2_control.types import Array

_KINDS = ("revolute", "prismatic")


def turns(chain: Sequence[ET.Element]) -> bool:
    """Whether a chain of finger joints is of joints with one axis, some of which turn."""
    kinds = [joint.get("type") for joint in chain]
    return all(kind in _KINDS for kind in kinds) and "revolute" in kinds


def finger_joint(
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
    driver, multiplier, offset = _driver(tree, joint, driven if stroke is not None else ())
    lower, upper = joint_limits(driver)
    closed, opened = (lower, upper) if stroke is None else stroke
    before, beyond = (lower, upper) if opened >= closed else (upper, lower)
    placement = model.frames[model.getFrameId(name, pin.FrameType.FIXED_JOINT)].placement
    axis: Array = placement.rotation @ joint_axis(joint)
    return FingerJoint(
        slides=joint.get("type") == "prismatic",
        axis=np.asarray(axis),
        point=np.array(placement.translation),
        home=home.get(name, 0.0),
        closed=multiplier * closed + offset,
        open=multiplier * opened + offset,
        before=multiplier * before + offset,
        beyond=multiplier * beyond + offset,
        driver=driver.get("name", ""),
    )


def _driver(tree: LinkTree, joint: ET.Element, driven: Collection[str]) -> tuple[ET.Element, float, float]:
    """The joint that another one follows in the end, itself if none, and multiplier and offset of its position.

    A joint that the gripper drives is its own driver, whatever it mimics.
    """
    movable, multiplier, offset, seen = tree.movable(), 1.0, 0.0, {joint.get("name", "")}
    while joint.get("name", "") not in driven and (mimic := joint.find("mimic")) is not None:
        leader = mimic.get("joint", "")
        if leader not in movable or leader in seen:
            break
        seen.add(leader)
        offset += multiplier * float(mimic.get("offset", "0"))
        multiplier *= float(mimic.get("multiplier", "1"))
        joint = movable[leader]
    return joint, multiplier, offset
