"""Pinocchio's models of a URDF: the joints that move a tool are checked, all others locked, rotors added."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Mapping

import pinocchio as pin

from q2r2_control.errors import RobotError
from q2r2_control.robot.description import LinkTree, joint_limits
from q2r2_control.robot.locking import lock_joints
from q2r2_control.robot.urdf_parts import acceleration_limit

# Inertia that the rotor of a geared drive adds to its joint where the URDF does not say [kg m^2]. Without any, light
# wrist joints would need torques faster than a control loop gives them.
_USUAL_ARMATURE = 0.1


def checked_chain(tree: LinkTree, arm: str, frame: str, where: str) -> list[str]:
    """Names of the joints that move an arm's ``frame``, each of a kind and with limits that the controller can hold to.

    Raises :class:`RobotError` that begins with ``where``.
    """
    if frame != tree.root and frame not in tree.joint_to:
        raise RobotError(f"{where}: arm {arm}: no link {frame!r:.60}; links: {', '.join([tree.root, *tree.joint_to])}")
    chain = tree.chain(frame)
    if not chain:
        raise RobotError(f"{where}: arm {arm}: no movable joint carries {frame}")
    for joint in chain:
        name, kind = joint.get("name", ""), joint.get("type")
        if kind not in ("revolute", "prismatic") or joint.find("mimic") is not None:
            kind = kind if joint.find("mimic") is None else "mimic"
            raise RobotError(f"{where}: joint {name} is {kind}; an arm's joints have to be revolute or prismatic")
        lower, upper = joint_limits(joint)
        if not lower < upper:
            raise RobotError(
                f"{where}: joint {name} has position limits {lower:g} .. {upper:g}; expected lower < upper"
            )
        limit = joint.find("limit")
        for what in ("velocity", "effort"):
            value = 0.0 if limit is None else float(limit.get(what, "0"))
            if not value > 0:
                raise RobotError(f"{where}: joint {name} has {what} limit {value:g}; expected more than 0")
        if not (value := acceleration_limit(joint)) > 0:
            raise RobotError(f"{where}: joint {name} has acceleration limit {value:g}; expected more than 0, or none")
    return [joint.get("name", "") for joint in chain]


def build_models(
    urdf: ET.Element, chains: Mapping[str, list[str]], home: Mapping[str, float], where: str
) -> tuple[pin.Model, pin.GeometryModel]:
    """Kinematics with rotors, and collision shapes, with every joint outside ``chains`` locked at home.

    Raises :class:`RobotError` that begins with ``where``.
    """
    locked = copy.deepcopy(urdf)
    lock_joints(locked, {name for chain in chains.values() for name in chain}, home)
    try:
        text = ET.tostring(locked, encoding="unicode")
        model = pin.buildModelFromXML(text)
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
        if geometry.ngeoms != (written := len(urdf.findall("link/collision"))):
            raise RobotError(f"{where}: Pinocchio read {geometry.ngeoms} of {written} collision shapes")
    except (ValueError, RuntimeError, IndexError) as error:
        raise RobotError(f"{where}: Pinocchio cannot read it: {' '.join(str(error).split())}") from error
    _set_rotors(model, urdf)
    return model, geometry


def _set_rotors(model: pin.Model, urdf: ET.Element) -> None:
    """Put each joint's rotor into the model, its armature (rotor inertia times gear squared) included."""
    model.armature[:] = _USUAL_ARMATURE
    for joint in urdf.findall("joint"):
        rotor, name = joint.find("rotor"), joint.get("name", "")
        if rotor is None or not model.existJointName(name):
            continue
        index = model.joints[model.getJointId(name)].idx_v
        inertia, gear = float(rotor.get("inertia", "0")), float(rotor.get("gear", "1"))
        model.rotorInertia[index] = inertia
        model.rotorGearRatio[index] = gear
        model.armature[index] = inertia * gear**2 or _USUAL_ARMATURE
