"""Write the robot of an MJCF file as a URDF. The URDF describes the model that MuJoCo compiles from the file.

MJCF has no speed limits, and so the caller gives them. The scene around the robot is left out, and so is everything
that moves freely in the scene. Kinematic loops that constraints close stay open.
"""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.errors import RobotError
from q2r2_control.extras import importing
from q2r2_control.robot.urdf_parts import numbers
from q2r2_control.types import Array

with importing("sim", "an MJCF file"):
    import mujoco

_MESHES = (".stl", ".obj")  # Formats of meshes that other programs than MuJoCo read as well.
_TOOL_SITE = re.compile(r"attachment|tcp|tool|end_?eff|(^|_)eef?(_|$)|grasp|pinch|flange", re.IGNORECASE)
_Joint, _Geom = mujoco.mjtJoint, mujoco.mjtGeom
_ON_JOINTS = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
# Mass [kg] and principal inertia [kg m^2] of the links between two joints of one body. Simulations refuse links without
# a mass.
_NEXT_TO_NONE = 1e-6, np.full(3, 1e-9)


def urdf_of_mjcf(file: Path, folder: Path, velocity: float) -> ET.Element:
    """Return the robot of an MJCF file as a URDF tree.

    Args:
        file: The MJCF file.
        folder: The folder of the URDF. The paths of meshes are relative to it.
        velocity: The speed limit of joints that turn [rad/s]. Joints that slide get no speed limit.

    Raises:
        RobotError: If MuJoCo cannot read the file, or if it has joints or shapes that a URDF cannot describe.
    """
    try:
        if (kind := ET.parse(file).getroot().tag) != "mujoco":
            raise RobotError(f"{file}: the root element is <{kind}>; an MJCF starts with <mujoco>")
        spec = mujoco.MjSpec.from_file(str(file.resolve()))
        spec.compiler.fusestatic = False  # With this value, the base stays one of the robot's links.
        model = spec.compile()
    except (ValueError, OSError, ET.ParseError) as error:
        raise RobotError(f"{file}: MuJoCo cannot read it: {' '.join(str(error).split())}") from error
    try:
        for mesh in spec.meshes:
            if mesh.refpos.any() or mesh.refquat[1:].any():
                raise RobotError(f"mesh {mesh.name} has refpos or refquat; allowed: a mesh that is in place as it is")
        return _Writer(model, file.stem, folder, velocity).robot()
    except RobotError as error:
        raise RobotError(f"{file}: {error}") from None


class _Writer:
    """Converts one model into a URDF.

    The frame of a link has its origin at the last joint of the body, and the axes of the body.
    """

    def __init__(self, model: mujoco.MjModel, name: str, folder: Path, velocity: float) -> None:
        self._model, self._folder, self._velocity = model, folder, velocity
        self._urdf = ET.Element("robot", name=name)
        self._names = {model.body(body).name for body in range(model.nbody)}
        self._names |= {model.joint(j).name for j in range(model.njnt)}
        self._links: dict[int, str] = {}  # Names of links by the number of their body.
        self._within: dict[int, pin.SE3] = {}  # For each body, the pose of its link's frame in the frame of the body.

    def robot(self) -> ET.Element:
        model = self._model
        if _Joint.mjJNT_BALL in model.jnt_type:
            raise RobotError(f"joint {model.joint(list(model.jnt_type).index(_Joint.mjJNT_BALL)).name} is a ball joint")
        roots = dict.fromkeys(int(model.body_rootid[body]) for body in range(model.nbody) if self._joints(body))
        if not roots:
            raise RobotError("no joint that turns or slides")
        if len(roots) > 1 or self._joints(next(iter(roots))):
            self._add_link(0, self._new_name("mjcf_world"), pin.SE3.Identity())
        for body in range(1, model.nbody):  # In this order, parents come before their children.
            if int(model.body_rootid[body]) in roots:
                self._add_body(body)
        self._add_mimics()
        return self._urdf

    def _joints(self, body: int) -> list[int]:
        first, count = self._model.body_jntadr[body], self._model.body_jntnum[body]
        return [j for j in range(first, first + count) if self._model.jnt_type[j] != _Joint.mjJNT_FREE]

    def _add_body(self, body: int) -> None:
        model, parent = self._model, int(self._model.body_parentid[body])
        name, within = model.body(body).name or self._new_name(f"body_{body}"), pin.SE3.Identity()
        if parent in self._links:
            link = self._links[parent]
            at = self._within[parent].inverse() * _pose(model.body_pos[body], model.body_quat[body])
            joints = self._joints(body)
            for j in joints:
                within = pin.SE3(np.eye(3), model.jnt_pos[j].copy())
                child = name if j == joints[-1] else self._new_name(f"{name}_before_{self._name(j)}")
                if child != name:
                    self._add_inertial(
                        ET.SubElement(self._urdf, "link", name=child), pin.SE3.Identity(), *_NEXT_TO_NONE
                    )
                self._add_moving_joint(j, link, child, at * within)
                link, at = child, within.inverse()
            if not joints:
                self._add_joint(self._new_name(f"{name}_fixed"), "fixed", link, name, at)
        self._add_link(body, name, within)
        if body in self._links:
            self._add_tool_sites(body)

    def _add_tool_sites(self, body: int) -> None:
        """Write sites with the name of a tool's frame as links, which a cell can name as tips. A URDF has no sites."""
        model = self._model
        for i in np.flatnonzero(model.site_bodyid == body).tolist():
            if _TOOL_SITE.search(site := model.site(i).name):
                at = self._within[body].inverse() * _pose(model.site_pos[i], model.site_quat[i])
                link = self._new_name(site)
                ET.SubElement(self._urdf, "link", name=link)
                self._add_joint(self._new_name(f"{link}_fixed"), "fixed", self._links[body], link, at)

    def _new_name(self, wanted: str) -> str:
        while wanted in self._names:
            wanted += "_"
        self._names.add(wanted)
        return wanted

    def _name(self, j: int) -> str:
        return self._model.joint(j).name or f"joint_{j}"

    def _add_joint(self, name: str, kind: str, parent: str, child: str, at: pin.SE3) -> ET.Element:
        joint = ET.SubElement(self._urdf, "joint", name=name, type=kind)
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        _add_origin(joint, at)
        return joint

    def _add_moving_joint(self, j: int, parent: str, child: str, at: pin.SE3) -> None:
        """Add the joint with the index ``j``. ``at`` is its pose in ``parent`` at the body's position in the file."""
        model = self._model
        axis, there = model.jnt_axis[j], float(model.qpos0[model.jnt_qposadr[j]])
        turns, limited = model.jnt_type[j] == _Joint.mjJNT_HINGE, bool(model.jnt_limited[j])
        zero = pin.SE3(pin.exp3(-there * axis), np.zeros(3)) if turns else pin.SE3(np.eye(3), -there * axis)
        kind = "prismatic" if not turns else "revolute" if limited else "continuous"
        joint = self._add_joint(self._name(j), kind, parent, child, at * zero)
        ET.SubElement(joint, "axis", xyz=numbers(axis))
        limit = ET.SubElement(joint, "limit", effort=repr(self._effort(j)), velocity=repr(self._velocity * turns))
        if limited:
            limit.set("lower", repr(float(model.jnt_range[j, 0])))
            limit.set("upper", repr(float(model.jnt_range[j, 1])))
        dof = model.jnt_dofadr[j]
        damping, friction = float(model.dof_damping[dof]), float(model.dof_frictionloss[dof])
        ET.SubElement(joint, "dynamics", damping=repr(damping), friction=repr(friction))
        armature = float(model.dof_armature[dof])
        if hasattr(model, "actuator_armature"):  # MuJoCo 4 and later have this attribute.
            for a in self._actuators(j):
                armature += float(model.actuator_gear[a, 0] ** 2 * model.actuator_armature[a])
        if armature > 0.0:
            ET.SubElement(joint, "rotor", inertia=repr(armature), gear="1")

    def _actuators(self, j: int) -> list[int]:
        model = self._model
        return [
            a
            for a in np.flatnonzero(model.actuator_trnid[:, 0] == j).tolist()
            if model.actuator_trntype[a] in _ON_JOINTS
        ]

    def _effort(self, j: int) -> float:
        """Return the least limit of the joint's force in either direction [N or Nm]; 0 if the file has none."""
        model, found = self._model, []
        if model.jnt_actfrclimited[j]:
            found.append(np.abs(model.jnt_actfrcrange[j]).min())
        for a in self._actuators(j):
            gear = abs(model.actuator_gear[a, 0])
            if model.actuator_forcelimited[a]:
                found.append(gear * np.abs(model.actuator_forcerange[a]).min())
            if model.actuator_ctrllimited[a] and model.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_NONE:
                gain = abs(model.actuator_gainprm[a, 0])
                found.append(gear * gain * np.abs(model.actuator_ctrlrange[a]).min())
        return float(min(found, default=0.0))

    def _add_link(self, body: int, name: str, within: pin.SE3) -> None:
        model = self._model
        self._links[body], self._within[body] = name, within
        link = ET.SubElement(self._urdf, "link", name=name)
        if body == 0:  # The shapes of the world body belong to the scene.
            return
        if model.body_mass[body] > 0.0:
            at = within.inverse() * _pose(model.body_ipos[body], model.body_iquat[body])
            self._add_inertial(link, at, float(model.body_mass[body]), model.body_inertia[body])
        first = model.body_geomadr[body]
        geoms = range(first, first + model.body_geomnum[body])
        paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
        touching = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g] or g in paired]
        for g in geoms:
            at = within.inverse() * _pose(model.geom_pos[g], model.geom_quat[g])
            # If none of a body's shapes may touch anything, all of them count, because otherwise the body would not be
            # watched.
            if g in touching or not touching:
                self._add_shape(link, "collision", g, at)
            if g not in touching:
                self._add_shape(link, "visual", g, at)

    def _add_inertial(self, link: ET.Element, at: pin.SE3, mass: float, principal: Array) -> None:
        inertial = ET.SubElement(link, "inertial")
        _add_origin(inertial, at)
        ET.SubElement(inertial, "mass", value=repr(mass))
        ixx, iyy, izz = map(repr, principal.tolist())
        ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")

    def _add_shape(self, link: ET.Element, kind: str, g: int, at: pin.SE3) -> None:
        model, size = self._model, self._model.geom_size[g].tolist()
        name, form = f"{link.get('name')}_{kind}_{g}", _Geom(int(model.geom_type[g]))
        shape = ET.SubElement(link, kind, name=name)
        geometry = ET.SubElement(shape, "geometry")
        if form == _Geom.mjGEOM_MESH:
            mesh = int(model.geom_dataid[g])
            # MuJoCo moves each mesh so that its frame is at the centre of mass, along the principal axes. This is
            # undone here.
            at = at * _pose(model.mesh_pos[mesh], model.mesh_quat[mesh]).inverse()
            scale = numbers(model.mesh_scale[mesh])
            ET.SubElement(geometry, "mesh", filename=self._mesh_file(mesh), scale=scale)
        elif form == _Geom.mjGEOM_SPHERE:
            ET.SubElement(geometry, "sphere", radius=repr(size[0]))
        elif form in (_Geom.mjGEOM_CAPSULE, _Geom.mjGEOM_CYLINDER):
            ET.SubElement(geometry, "cylinder", radius=repr(size[0]), length=repr(2.0 * size[1]))
            if form == _Geom.mjGEOM_CAPSULE and kind == "collision":
                ET.SubElement(ET.SubElement(link, "collision_checking"), "capsule", name=name)
        elif form in (_Geom.mjGEOM_BOX, _Geom.mjGEOM_ELLIPSOID):  # An ellipsoid becomes the box around it.
            ET.SubElement(geometry, "box", size=numbers([2.0 * half for half in size]))
        else:
            raise RobotError(f"body {link.get('name')} has a shape of kind {form.name}; allowed: solids and meshes")
        _add_origin(shape, at)
        if kind == "visual":
            material = model.geom_matid[g]
            colour = model.geom_rgba[g] if material < 0 else model.mat_rgba[material]
            ET.SubElement(ET.SubElement(shape, "material", name=f"{name}_colour"), "color", rgba=numbers(colour))

    def _mesh_file(self, mesh: int) -> str:
        model, start = self._model, int(self._model.mesh_pathadr[mesh])
        path = Path("" if start < 0 else model.paths[start : model.paths.index(b"\0", start)].decode())
        if path.suffix.lower() not in _MESHES:
            raise RobotError(
                f"mesh {model.mesh(mesh).name}: {path}; allowed: a file that ends in {' or '.join(_MESHES)}"
            )
        return os.path.relpath(path, self._folder.resolve())

    def _add_mimics(self) -> None:
        """Add a <mimic> to joints that a constraint makes a linear function of another joint."""
        model, joints = self._model, {joint.get("name"): joint for joint in self._urdf.findall("joint")}
        for e in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0):
            (follower, leader), factors = (int(model.eq_obj1id[e]), int(model.eq_obj2id[e])), model.eq_data[e, :5]
            if leader >= 0 and not factors[2:].any() and self._name(follower) in joints:
                zero = [float(model.qpos0[model.jnt_qposadr[j]]) for j in (follower, leader)]
                offset = float(factors[0] + zero[0] - factors[1] * zero[1])
                attributes = {
                    "joint": self._name(leader),
                    "multiplier": repr(float(factors[1])),
                    "offset": repr(offset),
                }
                ET.SubElement(joints[self._name(follower)], "mimic", attributes)


def _pose(position: Array, quaternion: Array) -> pin.SE3:
    """Return the pose of MuJoCo's arrays, whose quaternions are w, x, y, z."""
    return pin.SE3(pin.Quaternion(*quaternion.tolist()).normalized().matrix(), position.copy())


def _add_origin(element: ET.Element, pose: pin.SE3) -> None:
    ET.SubElement(element, "origin", xyz=numbers(pose.translation), rpy=numbers(pin.rpy.matrixToRpy(pose.rotation)))
