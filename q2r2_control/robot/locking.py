"""Joints that nothing drives become fixed ones, at one position, so that every reader of the URDF locks them alike."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.robot.description import joint_limits
from q2r2_control.types import Array


def joint_origin(joint: ET.Element) -> pin.SE3:
    """Placement of a joint's child link in its parent link, at position 0."""
    origin = joint.find("origin")
    xyz, rpy = (
        np.array([float(part) for part in ("" if origin is None else origin.get(name, "")).split()] or [0.0] * 3)
        for name in ("xyz", "rpy")
    )
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)


def lock_joints(robot: ET.Element, movable: Collection[str], positions: Mapping[str, float]) -> None:
    """Fix every joint of the URDF ``robot`` but the ``movable`` ones, in place.

    A joint with one axis is fixed at its value in ``positions`` [rad or m], at 0 without one; a planar or floating
    joint where it stands.
    """
    for joint in robot.findall("joint"):
        name = joint.get("name", "")
        if joint.get("type") == "fixed" or name in movable:
            continue
        position = positions.get(name, 0.0)
        if position != 0.0 and joint.get("type") in ("revolute", "continuous", "prismatic"):
            _set_origin(joint, joint_origin(joint) * _displacement(joint, position))
        joint.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration", "rotor"):
            for element in joint.findall(tag):
                joint.remove(element)


def resting_position(joint: ET.Element) -> float:
    """0, or what the joint's limits allow that is nearest to it."""
    lower, upper = joint_limits(joint)
    return min(max(0.0, lower), upper)


def joint_axis(joint: ET.Element) -> Array:
    """Unit vector (3,) that a joint turns about or slides along, in its own frame."""
    element = joint.find("axis")
    axis = np.array([float(part) for part in ("" if element is None else element.get("xyz", "")).split()] or [1, 0, 0])
    return np.asarray(axis / np.linalg.norm(axis))


def _displacement(joint: ET.Element, position: float) -> pin.SE3:
    axis = joint_axis(joint)
    if joint.get("type") == "prismatic":
        return pin.SE3(np.eye(3), position * axis)
    return pin.SE3(pin.AngleAxis(math.remainder(position, 2 * math.pi), axis).matrix(), np.zeros(3))


def _set_origin(joint: ET.Element, placement: pin.SE3) -> None:
    origin = joint.find("origin")
    if origin is None:
        origin = ET.SubElement(joint, "origin")
    origin.set("xyz", " ".join(repr(float(value)) for value in placement.translation))
    origin.set("rpy", " ".join(repr(float(value)) for value in pin.rpy.matrixToRpy(placement.rotation)))
