"""Handle parts of a URDF that different programs understand in different ways.

Each part is brought to one form, refused, or reported. Readers of URDF silently skip elements that they do not know. In
their models, a hand, a mass or half of a joint's range could be missing.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.errors import RobotError

# Greatest usual limits of the angle of a joint that counts its turns [rad], and of the speed of an arm's joint [rad/s].
# Larger limits are probably in degrees.
LARGEST_ANGLE = 6.0 * math.pi
LARGEST_SPEED = 40.0
_UNIT = re.compile(r"<unit\b[^>]*\bmeter\s*=\s*[\"']([0-9.eE+-]+)[\"']")
_HEADER = 20_000  # Number of characters at the beginning of a COLLADA file in which its unit is searched.
_UNIT_LENGTH = 1e-3  # Greatest difference of a quaternion's length from 1.


def unify(root: ET.Element, where: str) -> None:
    """Convert the quaternions of origins to roll, pitch and yaw in place.

    Raises:
        RobotError: With a text that begins with ``where``, if there are elements of xacro, which all readers skip. Also
            if a link has only one of mass and inertia, because Pinocchio leaves out such a link with its shapes.
    """
    _refuse_xacro(root, where)
    for origin in root.iter("origin"):
        _unify_origin(origin, where)
    for link in root.findall("link"):
        _check_inertial(link, where)


@dataclass(frozen=True, slots=True)
class LimitNote:
    """A line about limits of a joint that a user should check."""

    joint: str
    text: str
    asks_for_units: bool  # True if the line asks whether the limits are in degrees.


def notes_on(root: ET.Element) -> list[LimitNote]:
    """Return notes on the joints whose limits a user should check. ``root`` is the model as it was written."""
    notes = []
    for joint in root.findall("joint"):
        name, limit = joint.get("name", ""), joint.find("limit")
        if (soft := _soft_limits(joint)) is not None:
            range_ = f"{soft[0]:g} .. {soft[1]:g}"
            text = f"{name} may leave the soft limits of its safety_controller, {range_}; to keep them: its <limit>"
            notes.append(LimitNote(name, text, asks_for_units=False))
        if limit is None or joint.get("type") != "revolute":
            continue
        lower, upper, speed = (float(limit.get(what, "0")) for what in ("lower", "upper", "velocity"))
        if max(-lower, upper) > LARGEST_ANGLE or speed > LARGEST_SPEED:
            limits = f"{lower:g} .. {upper:g} rad and {speed:g} rad/s"
            text = f"{name} has limits of {limits}; a URDF has radians: are these degrees?"
            notes.append(LimitNote(name, text, asks_for_units=True))
    return notes


def scale_to_metres(meshes: Iterable[ET.Element]) -> None:
    """Scale the meshes of collision shapes in place by the length unit of their files.

    COLLADA files name a unit, which RViz applies and Pinocchio ignores.
    """
    for mesh in meshes:
        if (unit := _unit_of(mesh.get("filename", ""))) != 1.0:
            scale = [unit * float(part) for part in mesh.get("scale", "1 1 1").split()]
            mesh.set("scale", " ".join(map(repr, scale)))


def _soft_limits(joint: ET.Element) -> tuple[float, float] | None:
    """Return the part of a joint's position range that its ``safety_controller`` leaves; None if it leaves all of it.

    Soft limits without a width do not count, because both of them are 0 if they are not written.
    """
    safety, limit = joint.find("safety_controller"), joint.find("limit")
    if safety is None or limit is None or joint.get("type") not in ("revolute", "prismatic"):
        return None
    hard = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
    soft = float(safety.get("soft_lower_limit", "0")), float(safety.get("soft_upper_limit", "0"))
    left = max(hard[0], soft[0]), min(hard[1], soft[1])
    return left if soft[0] < soft[1] and left != hard and left[0] < left[1] else None


def _unit_of(file: str) -> float:
    """Return the length of a mesh file's unit [m]."""
    if not file.lower().endswith(".dae"):
        return 1.0
    with Path(file).open(encoding="utf-8", errors="replace") as opened:
        found = _UNIT.search(opened.read(_HEADER))
    return float(found[1]) if found else 1.0


def _refuse_xacro(root: ET.Element, where: str) -> None:
    found = dict.fromkeys(
        one.tag.rpartition("}")[2] for one in root.iter() if "xacro" in str(one.tag).partition("}")[0]
    )
    if found:
        names = ", ".join(f"xacro:{name}" for name in found)
        allowed = "what xacro makes of it, or a name that ends in .xacro"
        raise RobotError(f"{where}: has {names:.100}, which readers of URDF skip; allowed: {allowed}")


def _unify_origin(origin: ET.Element, where: str) -> None:
    text = origin.attrib.pop("quat_xyzw", None)
    if text is None:
        return
    try:
        x, y, z, w = map(float, text.split())
    except ValueError:
        x = y = z = w = math.nan
    if not abs(math.hypot(x, y, z, w) - 1.0) <= _UNIT_LENGTH or "rpy" in origin.attrib:
        allowed = "four numbers of length 1, and no rpy beside it"
        raise RobotError(f"{where}: an origin has quat_xyzw = {text!r:.60}; allowed: {allowed}")
    rpy = pin.rpy.matrixToRpy(pin.Quaternion(np.array([x, y, z, w])).normalized().matrix())
    origin.set("rpy", " ".join(map(repr, rpy.tolist())))


def _check_inertial(link: ET.Element, where: str) -> None:
    """Refuse an <inertial> that lacks its mass or its inertia. Pinocchio leaves out the shapes of such a link."""
    if (inertial := link.find("inertial")) is None:
        return
    lacks = [tag for tag in ("mass", "inertia") if inertial.find(tag) is None]
    if len(lacks) == 1:
        raise RobotError(f"{where}: the <inertial> of link {link.get('name')} has no <{lacks[0]}>; allowed: both")
    if lacks:  # An empty element means the same as no element.
        link.remove(inertial)
