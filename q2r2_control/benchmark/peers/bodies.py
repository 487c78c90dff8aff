"""The cell's URDF with our bodies as its collision shapes, for peers that read a robot from a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import coal
import pinocchio as pin

from q2r2_control.benchmark.peers.base import PeerSettings
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.urdf_parts import numbers


def urdf_with_our_bodies(setup: PeerSettings) -> str:
    """Return the cell's URDF with our bodies as collision shapes. Its position limits are reduced by our margin."""
    root = ET.fromstring(setup.robot.urdf)
    for name, lower, upper in zip(setup.robot.joint_names, setup.lower, setup.upper, strict=True):
        limit = root.find(f"joint[@name='{name}']/limit")
        if limit is not None:
            limit.set("lower", repr(float(lower)))
            limit.set("upper", repr(float(upper)))
    links = {link.get("name"): link for link in root.iterfind("link")}
    for link in links.values():
        for shape in [*link.findall("collision"), *link.findall("collision_checking")]:
            link.remove(shape)
    for item in setup.robot.collision_model.geometryObjects:
        _add_body(links[link_of(item.name)], item, setup.robot)
    return ET.tostring(root, encoding="unicode")


def _add_body(link: ET.Element, item: pin.GeometryObject, robot: Robot) -> None:
    frame = robot.model.frames[robot.model.getFrameId(link_of(item.name), pin.FrameType.BODY)]
    placement = frame.placement.actInv(item.placement)
    body, shape = ET.SubElement(link, "collision", name=item.name), item.geometry
    rpy = pin.rpy.matrixToRpy(placement.rotation)
    ET.SubElement(body, "origin", xyz=numbers(placement.translation), rpy=numbers(rpy))
    geometry = ET.SubElement(body, "geometry")
    if isinstance(shape, coal.Box):
        ET.SubElement(geometry, "box", size=numbers(2.0 * shape.halfSide))
    elif isinstance(shape, coal.Sphere):
        ET.SubElement(geometry, "sphere", radius=repr(shape.radius))
    else:
        ET.SubElement(geometry, "cylinder", radius=repr(shape.radius), length=repr(2.0 * shape.halfLength))
        ET.SubElement(ET.SubElement(link, "collision_checking"), "capsule", name=item.name)
