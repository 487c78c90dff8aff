"""Make our :class:`Robot` from any model that MuJoCo has compiled, with the same joints, mounts and shapes.

Kinematics and position limits come from the model. A MuJoCo model has no velocity limits, so the caller gives them.
A gripper is a part of the link to which it is attached. Its shape contains everything that it sweeps between open and
closed.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import mujoco
import numpy as np
import pinocchio as pin

from q2r2_control.robot.enclose import capsule_between, enclosing_capsule
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.urdf_parts import WORLD, numbers
from q2r2_control.types import Array

_CIRCLE_CORNERS = 16  # Number of corners of the polygon around a circle.


@dataclass(frozen=True)
class ArmModel:
    """The names of one arm's parts in a MuJoCo model."""

    base: str  # Base body. The arm consists of this body and all its descendants.
    joints: tuple[str, ...]  # Hinge joints from base to tool.
    velocity_limit: Array  # Velocity limit of each joint (n,) [rad/s].
    tool: str  # Site that the controller moves.


def robot_of(model: mujoco.MjModel, arms: Mapping[str, ArmModel], closing: Sequence[Array]) -> Robot:
    """Return the robot that consists of some arms of a MuJoCo ``model``.

    Args:
        model: The model.
        arms: The names of each arm's parts, by the name of the arm.
        closing: At least two positions (nq,) of the whole model. In all of them, the arms are at home. The grippers are
            open in the first one and closed in the last one. One capsule encloses everything that a finger's shape
            sweeps from one position to the next.
    """
    urdf = ET.Element("robot", name="arena")
    ET.SubElement(urdf, "link", name=WORLD)
    states = [_placed(model, q) for q in closing]
    zero = _placed(model, closing[0], {joint: 0.0 for arm in arms.values() for joint in arm.joints})
    for name, arm in arms.items():
        _add_arm(urdf, model, name, arm, zero, states)
    home = {joint: float(states[0].joint(joint).qpos[0]) for arm in arms.values() for joint in arm.joints}
    tools = {name: f"{name}_tool" for name in arms}
    return Robot.from_urdf(ET.tostring(urdf, encoding="unicode"), arms=tools, home=home)


def bodies_of(model: mujoco.MjModel, base: str) -> list[int]:
    """Return the body ``base`` and all its descendants, each of them after its parent."""
    found = [model.body(base).id]
    for body in range(found[0] + 1, model.nbody):
        if model.body_parentid[body] in found:
            found.append(body)
    return found


def geoms_of(model: mujoco.MjModel, arm: ArmModel) -> list[int]:
    """Return the shapes of an arm and its mount that can touch anything."""
    bodies = bodies_of(model, arm.base)
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    return [geom for geom in range(model.ngeom) if solid[geom] and model.geom_bodyid[geom] in bodies]


def tool_pose(data: mujoco.MjData, arm: ArmModel) -> pin.SE3:
    """Return the pose of the arm's tool in MuJoCo, in the world frame."""
    site = data.site(arm.tool)
    return pin.SE3(site.xmat.reshape(3, 3).copy(), site.xpos.copy())


def _placed(model: mujoco.MjModel, q: Array, joints: Mapping[str, float] | None = None) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = q
    for joint, value in (joints or {}).items():
        data.joint(joint).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    return data


def _add_arm(
    urdf: ET.Element,
    model: mujoco.MjModel,
    name: str,
    arm: ArmModel,
    zero: mujoco.MjData,
    states: Sequence[mujoco.MjData],
) -> None:
    bodies = bodies_of(model, arm.base)
    joints = {int(model.joint(joint).bodyid[0]): joint for joint in arm.joints}
    # Each body is mapped to the body whose arm joint moves it. Fingers therefore count as parts of their hand.
    carrier: dict[int, int] = {}
    for body in bodies:
        carrier[body] = body if body in joints or body == bodies[0] else carrier[model.body_parentid[body]]
    for body in dict.fromkeys(carrier.values()):
        link = ET.SubElement(urdf, "link", name=model.body(body).name)
        parent = None if body == bodies[0] else carrier[model.body_parentid[body]]
        joint = _joint(urdf, model, zero, parent, body)
        if body in joints:
            limit = arm.velocity_limit[arm.joints.index(joints[body])]
            _make_revolute(joint, model.joint(joints[body]), limit)
        for geom in geoms_of(model, arm):
            owner = int(model.geom_bodyid[geom])
            if carrier.get(owner) == body:
                fixed = _carries(model, body, owner)
                for number, sweep in enumerate([states[:1]] if fixed else pairwise(states)):
                    _add_capsule(link, f"{model.geom(geom).name}_{number}", _swept(model, sweep, body, geom))
    site = model.site(arm.tool).id
    hand = carrier[int(model.site_bodyid[site])]
    shift = _pose(zero, hand).actInv(tool_pose(zero, arm))
    ET.SubElement(urdf, "link", name=f"{name}_tool")
    _fixed_joint(urdf, f"{name}_tool_mount", model.body(hand).name, f"{name}_tool", shift)


def _carries(model: mujoco.MjModel, link: int, body: int) -> bool:
    """Return whether there is no joint between a link and its descendant ``body``."""
    while body != link:
        if model.body_jntnum[body]:
            return False
        body = int(model.body_parentid[body])
    return True


def _joint(urdf: ET.Element, model: mujoco.MjModel, zero: mujoco.MjData, parent: int | None, body: int) -> ET.Element:
    pose = _pose(zero, body) if parent is None else _pose(zero, parent).actInv(_pose(zero, body))
    numbered = model.body_jntadr[body]
    name = model.joint(numbered).name if numbered >= 0 else f"{model.body(body).name}_mount"
    return _fixed_joint(urdf, name, WORLD if parent is None else model.body(parent).name, model.body(body).name, pose)


def _fixed_joint(urdf: ET.Element, name: str, parent: str, child: str, pose: pin.SE3) -> ET.Element:
    joint = ET.SubElement(urdf, "joint", name=name, type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    _add_origin(joint, pose)
    return joint


def _make_revolute(element: ET.Element, joint: mujoco._structs._MjModelJointViews, velocity: float) -> None:
    if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE or joint.pos.any() or not joint.limited[0]:
        raise ValueError(f"{joint.name}: allowed: a hinge with limits, at its body's origin")
    lower, upper = joint.range
    element.set("type", "revolute")
    ET.SubElement(element, "axis", xyz=numbers(joint.axis))
    ET.SubElement(element, "limit", lower=str(lower), upper=str(upper), velocity=str(velocity), effort="1000")


def _add_capsule(link: ET.Element, name: str, points: Array) -> None:
    radius, *ends = enclosing_capsule(points)
    capsule, pose = capsule_between(radius, *ends)
    collision = ET.SubElement(link, "collision", name=name)
    _add_origin(collision, pose)
    size = {"radius": repr(float(capsule.radius)), "length": repr(float(2 * capsule.halfLength))}
    ET.SubElement(ET.SubElement(collision, "geometry"), "cylinder", size)
    declared = link.find("collision_checking")  # A link has only one such element, because parsers ignore a second one.
    if declared is None:
        declared = ET.SubElement(link, "collision_checking")
    ET.SubElement(declared, "capsule", name=name)


def _add_origin(element: ET.Element, pose: pin.SE3) -> None:
    ET.SubElement(element, "origin", xyz=numbers(pose.translation), rpy=numbers(pin.rpy.matrixToRpy(pose.rotation)))


def _swept(model: mujoco.MjModel, states: Sequence[mujoco.MjData], body: int, geom: int) -> Array:
    """Return points (n, 3) whose convex hull contains a shape in all ``states``, in the frame of ``body`` [m]."""
    points = []
    for data in states:
        shape = pin.SE3(data.geom_xmat[geom].reshape(3, 3).copy(), data.geom_xpos[geom].copy())
        pose = _pose(data, body).actInv(shape)
        points.append(corners_of(model, geom) @ pose.rotation.T + pose.translation)
    return np.concatenate(points)


def corners_of(model: mujoco.MjModel, geom: int) -> Array:
    """Return points (n, 3) whose convex hull contains a shape, in the shape's own frame [m]."""
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    kind = model.geom_type[geom]
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        return np.array(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], dtype=np.float64)
    if kind == kinds.mjGEOM_CYLINDER:
        angles = np.arange(_CIRCLE_CORNERS) * 2 * np.pi / _CIRCLE_CORNERS
        radius = size[0] / np.cos(np.pi / _CIRCLE_CORNERS)
        circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        return np.concatenate([np.column_stack([circle, np.full(_CIRCLE_CORNERS, z)]) for z in (-size[1], size[1])])
    if kind == kinds.mjGEOM_BOX:
        return np.array(list(product((-1.0, 1.0), repeat=3))) * size
    raise ValueError(f"{model.geom(geom).name}: allowed: meshes, boxes and cylinders")


def _pose(data: mujoco.MjData, body: int) -> pin.SE3:
    return pin.SE3(data.xmat[body].reshape(3, 3).copy(), data.xpos[body].copy())
