"""Make Pinocchio's models of a URDF. The joints that move a tool are checked, and all others are locked."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.errors import RobotError
from q2r2_control.robot.description import LinkTree, joint_limits
from q2r2_control.robot.urdf_parts import acceleration_limit
from q2r2_control.types import Array


def joint_origin(joint: ET.Element) -> pin.SE3:
    """Return the placement of a joint's child link in its parent link, at position 0."""
    xyz, rpy = (_vector(joint.find("origin"), name) or [0.0, 0.0, 0.0] for name in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz))


def lock_joints(robot: ET.Element, movable: Collection[str], positions: Mapping[str, float]) -> None:
    """Change the URDF ``robot``: make every joint a fixed joint, except the joints in ``movable``.

    All programs that read this URDF then have the same fixed joints. A joint with one axis is fixed at its value in
    ``positions`` [rad or m], or at 0 if it has none. A planar or floating joint is fixed at its origin.
    """
    for joint in robot.findall("joint"):
        name, kind = joint.get("name", ""), joint.get("type")
        if kind == "fixed" or name in movable:
            continue
        position = positions.get(name, 0.0)
        if position != 0.0 and kind in ("revolute", "continuous", "prismatic"):
            axis = joint_axis(joint)
            turn = pin.AngleAxis(math.remainder(position, 2 * math.pi), axis).matrix()
            moved = pin.SE3(np.eye(3), position * axis) if kind == "prismatic" else pin.SE3(turn, np.zeros(3))
            place = joint_origin(joint) * moved
            if (origin := joint.find("origin")) is None:
                origin = ET.SubElement(joint, "origin")
            for key, values in (("xyz", place.translation), ("rpy", pin.rpy.matrixToRpy(place.rotation))):
                origin.set(key, " ".join(repr(float(value)) for value in values))
        joint.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration", "rotor"):
            for element in joint.findall(tag):
                joint.remove(element)


def resting_position(joint: ET.Element) -> float:
    """Return the position nearest to 0 that the joint's limits allow."""
    lower, upper = joint_limits(joint)
    return min(max(0.0, lower), upper)


def joint_axis(joint: ET.Element) -> Array:
    """Return the unit vector (3,) about which a joint turns or along which it slides, in its own frame."""
    axis = np.array(_vector(joint.find("axis"), "xyz") or [1.0, 0.0, 0.0])
    return np.asarray(axis / np.linalg.norm(axis))


def _vector(element: ET.Element | None, attribute: str) -> list[float]:
    return [] if element is None else [float(part) for part in element.get(attribute, "").split()]


# Inertia that the rotor of a geared drive adds to a joint, if the URDF names no rotor [kg m^2]. Without this inertia,
# wrist joints would be so light that a control loop is too slow for them.
_USUAL_ARMATURE = 0.1


def checked_chain(tree: LinkTree, arm: str, frame: str, where: str) -> list[str]:
    """Return the names of the joints that move an arm's ``frame``.

    Raises:
        RobotError: If there are none, or if the controller cannot use the type or the limits of one of them. The text
            begins with ``where``.
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
            limits = f"position limits {lower:g} .. {upper:g}"
            raise RobotError(f"{where}: joint {name} has {limits}; expected lower < upper")
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
    """Return the kinematics with rotors, and the collision shapes, with every joint outside ``chains`` locked at home.

    Raises:
        RobotError: With a text that begins with ``where``, if Pinocchio cannot read the whole model.
    """
    locked = copy.deepcopy(urdf)
    lock_joints(locked, {name for chain in chains.values() for name in chain}, home)
    model, geometry = read_models(locked, where)
    if geometry.ngeoms != (written := len(urdf.findall("link/collision"))):
        raise RobotError(f"{where}: Pinocchio read {geometry.ngeoms} of {written} collision shapes")
    _set_rotors(model, urdf)
    return model, geometry


def read_models(urdf: ET.Element, where: str) -> tuple[pin.Model, pin.GeometryModel]:
    """Return the kinematics and the collision shapes as Pinocchio reads them.

    Raises:
        RobotError: With a text that begins with ``where``. It names a mesh that cannot be read or has no extent.
    """
    text = ET.tostring(urdf, encoding="unicode")
    try:
        model = pin.buildModelFromXML(text)
        geometry = pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError, IndexError) as error:
        for mesh in urdf.iterfind("link/collision/geometry/mesh"):
            _check_mesh(mesh.get("filename", ""), where)
        raise RobotError(f"{where}: Pinocchio cannot read it: {' '.join(str(error).split())}") from error
    for item in geometry.geometryObjects:
        if isinstance(item.geometry, coal.BVHModelBase) and not _has_extent(item.geometry):
            has = "has no triangles, or all in one line"
            raise RobotError(f"{where}: mesh {item.meshPath!r:.200} {has}; allowed: a body")
    return model, geometry


def _check_mesh(file: str, where: str) -> None:
    try:
        coal.MeshLoader().load(file, np.ones(3))
    except (ValueError, RuntimeError, IndexError) as error:
        is_pointer = Path(file).read_bytes().startswith(b"version https://git-lfs")
        allowed = "the file itself, for which this is Git LFS's pointer: git lfs pull" if is_pointer else "a whole mesh"
        raise RobotError(f"{where}: mesh {file!r:.200} cannot be read; allowed: {allowed}") from error


def _has_extent(mesh: coal.BVHModelBase) -> bool:
    """Return whether the corners of a mesh span more than a straight line."""
    points = np.array(mesh.vertices()).reshape(-1, 3)
    if len(points) < 3 or not np.isfinite(points).all():
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > 1e-9 * max(float(spread[0]), 1e-12))


def _set_rotors(model: pin.Model, urdf: ET.Element) -> None:
    """Write each joint's rotor into the model, with its armature (rotor inertia times gear ratio squared)."""
    model.armature[:] = _USUAL_ARMATURE
    for joint in urdf.findall("joint"):
        rotor, name = joint.find("rotor"), joint.get("name", "")
        if rotor is not None and model.existJointName(name):
            index = model.joints[model.getJointId(name)].idx_v
            inertia, gear = float(rotor.get("inertia", "0")), float(rotor.get("gear", "1"))
            model.rotorInertia[index], model.rotorGearRatio[index] = inertia, gear
            model.armature[index] = inertia * gear**2 or _USUAL_ARMATURE
