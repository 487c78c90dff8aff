"""Build the MuJoCo model of a cell from its URDF.

MuJoCo's URDF reader knows no capsules, rotors, SRDF or servos. This module adds them from the :class:`Robot` that the
controller uses.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from itertools import combinations

import coal
import numpy as np

from q2r2_control.config.cell import Config, MujocoConfig
from q2r2_control.errors import PlantError
from q2r2_control.extras import importing
from q2r2_control.plants.mujoco_cameras import add_cameras
from q2r2_control.plants.scene import (
    COLLISION_GROUP,
    ENVELOPE_GROUP,
    FRICTION_IMPEDANCE,
    PAD_PRIORITY,
    ROLLING,
    TORSION,
    VISUAL_GROUP,
    furnish,
    let_fingers_slide,
    let_objects_yield,
    set_obstacles,
)
from q2r2_control.robot.followers import Follower, followers_of
from q2r2_control.robot.pairs import ENVELOPE, link_of, pair_names
from q2r2_control.robot.robot import Robot

with importing("sim", "the simulation in MuJoCo"):
    import mujoco

# Least viscous friction of a joint, which keeps light wrist joints steady [Nm s/rad].
_MIN_DAMPING = 0.2

# A negligible inertia. It is a thousandth of the inertia that a drive's rotor adds to its joint [kg m^2].
_NEGLIGIBLE_INERTIA = 1e-6

# Coefficients of friction of rubber pads on a box: sliding, torsional [m] and rolling [m].
_PAD_FRICTION = (1.0, TORSION, ROLLING)

# Time constant [s] and damping ratio of a finger's contacts. MuJoCo scales the stiffness of a contact with the inertia
# of its bodies, and a finger has little inertia. With MuJoCo's usual time constant of 0.02 s, the fingers would sink
# millimetres into the held part.
_PAD_STIFFNESS = (0.004, 1.0)

# Formats of meshes that MuJoCo reads by itself.
_FORMATS = (".stl", ".obj", ".msh")

# A finger servo gives its full force if the error of its position is this share of the stroke.
_FINGER_SERVO_BAND = 0.05


def build_model(robot: Robot, config: Config) -> mujoco.MjModel:
    """Compile the model of the cell.

    Its first actuators are ``robot.joint_names`` in that order. The finger joints of each gripper follow.

    Raises:
        PlantError: If MuJoCo cannot make a model of the cell.
    """
    try:
        spec = mujoco.MjSpec.from_string(_readable_urdf(robot.urdf))
        spec.modelname = robot.name
        _load_meshes(spec)
        _correct_inertias(spec)
        _set_solver(spec, config.mujoco)
        _set_shapes(spec, robot)
        set_obstacles(spec, config)
        _set_arm_joints(spec, robot, config.mujoco)
        _set_grippers(spec, robot, config)
        _exclude_contacts(spec, robot)
        let_fingers_slide(spec, config)
        _add_objects(spec, config.mujoco)
        let_objects_yield(spec, config)
        add_cameras(spec, config.simulated_cameras)
        furnish(spec, floor=config.floor is not None)
        if massless := _moving_without_mass(spec):
            models = ", ".join(dict.fromkeys(map(config.model_of, robot.arms)))
            what = f"links that move without a mass, which simulation needs: {', '.join(massless)}"
            raise PlantError(f"{robot.name}: {what}; allowed: <inertial> with a mass in {models}")
        return spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise PlantError(f"{robot.name}: MuJoCo cannot make a model of it: {' '.join(str(error).split())}") from error


def _moving_without_mass(spec: mujoco.MjSpec) -> list[str]:
    """Return the names of all moving bodies that have no mass, and to which no body with a mass is fixed.

    MuJoCo's own error names only one of these bodies.
    """

    def mass(body: mujoco.MjsBody) -> float:
        fixed = (mass(child) for child in body.bodies if not child.joints)
        return float(body.mass) + sum(geom.mass for geom in body.geoms if geom.mass > 0.0) + sum(fixed)

    return [body.name for body in spec.bodies if body.joints and not mass(body) > 0.0]


def _readable_urdf(urdf: str) -> str:
    """Return the URDF with settings that keep every link as a body, and without meshes that MuJoCo cannot draw.

    Each <mimic> is removed, because not every version of MuJoCo reads it. :func:`_set_grippers` couples the joints.
    """
    root = ET.fromstring(urdf)
    extension = ET.SubElement(root, "mujoco")
    ET.SubElement(extension, "compiler", discardvisual="false", fusestatic="false", strippath="false")
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is not None and not mesh.get("filename", "").lower().endswith(_FORMATS):
                link.remove(visual)
    for joint in root.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    return ET.tostring(root, encoding="unicode")


def _load_meshes(spec: mujoco.MjSpec) -> None:
    """Use Coal to read every mesh of ``spec`` that MuJoCo cannot read, such as DAE. The mesh keeps its scale."""
    for mesh in spec.meshes:
        if mesh.file.lower().endswith(_FORMATS):
            continue
        try:
            read = coal.MeshLoader().load(mesh.file, np.ones(3))
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[-200:]
            raise PlantError(f"{mesh.file}: neither MuJoCo nor Coal can read it: {reason}") from error
        triangles = [read.tri_indices(index) for index in range(read.num_tris)]
        mesh.uservert = np.asarray(read.vertices(), dtype=float).ravel()
        mesh.userface = np.array([[corner[0], corner[1], corner[2]] for corner in triangles], dtype=int).ravel()
        mesh.file = ""


def _set_solver(spec: mujoco.MjSpec, config: MujocoConfig) -> None:
    spec.option.timestep = config.timestep
    # A diverged simulation is an error. Without this flag, MuJoCo would jump back to the start.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The elliptic cone with this ratio keeps grasped objects from creeping out of the fingers.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = FRICTION_IMPEDANCE


def _correct_inertias(spec: mujoco.MjSpec) -> None:
    """Increase eigenvalues of inertias that are slightly too small for any real body.

    Some files have such inertias for antennas of a milligram, and MuJoCo refuses these files as a whole. The added
    terms do not change the motion noticeably. MuJoCo still refuses inertias with larger errors.
    """
    for body in spec.bodies:
        if not body.explicitinertial or np.isnan(body.fullinertia).any():
            continue
        xx, yy, zz, xy, xz, yz = body.fullinertia
        values, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if -_NEGLIGIBLE_INERTIA < values[0] <= 0.0:
            full = (axes * np.maximum(values, _NEGLIGIBLE_INERTIA)) @ axes.T
            body.fullinertia = [*np.diag(full), full[0, 1], full[0, 2], full[1, 2]]


def _set_shapes(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Sort shapes into groups, and exclude envelopes from contacts.

    The URDF has a cylinder for each capsule. This function turns these cylinders into capsules.
    """
    declared = ET.fromstring(robot.urdf).iterfind("link/collision_checking/capsule")
    capsules = {capsule.get("name", "") for capsule in declared}
    for body in spec.bodies:
        drawn = any(not geom.contype for geom in body.geoms)
        for geom in body.geoms:
            # Shapes of a URDF have no mass. Without this line, links without a mass would get a mass from their shapes.
            geom.mass = 0.0
            if geom.name in capsules:
                geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            if not geom.contype:
                geom.group = VISUAL_GROUP
            elif geom.name.endswith(ENVELOPE):
                geom.group, geom.contype, geom.conaffinity = ENVELOPE_GROUP, 0, 0
            elif drawn:
                geom.group = COLLISION_GROUP


def _set_arm_joints(spec: mujoco.MjSpec, robot: Robot, config: MujocoConfig) -> None:
    for name, armature, torque in zip(robot.joint_names, robot.model.armature, robot.torque_limit, strict=True):
        joint = spec.joint(name)
        joint.armature = config.rotor_share * armature
        joint.damping[0] = max(joint.damping[0], _MIN_DAMPING)
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcerange = (-torque, torque)


def _set_grippers(spec: mujoco.MjSpec, robot: Robot, config: Config) -> None:
    """Add a servo for each finger joint, couple the joints of each gripper, and set the friction of its fingers.

    The gear of a gripper becomes equality constraints. A joint that mimics a finger joint follows this joint, and all
    finger joints have the same position. With the friction, the fingers can hold a box.
    """
    robot_urdf = ET.fromstring(robot.urdf)
    for side, arm in config.arms.items():
        gripper, names = arm.gripper, robot.arms[side].finger_joints
        if not names:
            continue
        stiffness = gripper.force / (_FINGER_SERVO_BAND * abs(gripper.open_position - gripper.closed_position))
        for name in names:
            servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=stiffness, dampratio=1.0)
            servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            servo.forcerange = (-gripper.force, gripper.force)
        couplings = dict.fromkeys(names[1:], Follower(names[0], 1.0, 0.0))
        followers = followers_of(robot_urdf.findall("joint"), driven=names)
        couplings |= {name: one for name, one in followers.items() if one.driver in names}
        for name, follower in couplings.items():
            coupling = spec.add_equality(name=f"{name}_coupling", name1=name, name2=follower.driver)
            coupling.type, coupling.objtype = mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtObj.mjOBJ_JOINT
            coupling.data[:5] = (follower.offset, follower.multiplier, 0, 0, 0)
        moved = [names[0], *couplings]
        for name in moved:
            for geom in spec.joint(name).parent.geoms:
                geom.condim, geom.friction, geom.solref = 4, _PAD_FRICTION, _PAD_STIFFNESS
                geom.priority = PAD_PRIORITY
        # Contacts between fingers are left out, because the joint limits already keep the fingers apart.
        for first, second in combinations(moved, 2):
            _exclude(spec, spec.joint(first).parent.name, spec.joint(second).parent.name)


def settle_mimics(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Move every joint that follows another one to the position that its coupling requires."""
    for i in range(model.neq):
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT:
            follower, leader = (model.jnt_qposadr[joint[i]] for joint in (model.eq_obj1id, model.eq_obj2id))
            data.qpos[follower] = np.polynomial.polynomial.polyval(data.qpos[leader], model.eq_data[i, :5])


def _exclude_contacts(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Exclude contacts of two links that are not a monitored pair: neighbours, and links that always or never touch."""
    watched = {frozenset((link_of(a), link_of(b))) for a, b in pair_names(robot.collision_model)}
    for first, second in combinations(sorted(frozenset().union(*watched)), 2):
        if frozenset((first, second)) not in watched:
            _exclude(spec, first, second)
    for name in robot.joint_names:
        # MuJoCo itself excludes contacts of a body with its parent only if that parent can move. Contacts with a fixed
        # parent are excluded here, unless the controller monitors the pair.
        link = spec.joint(name).parent
        if frozenset((link.parent.name, link.name)) not in watched:
            _exclude(spec, link.parent.name, link.name)


def _exclude(spec: mujoco.MjSpec, first: str, second: str) -> None:
    name = f"{first}|{second}"
    if spec.exclude(name) is None:
        spec.add_exclude(name=name, bodyname1=first, bodyname2=second)


def _add_objects(spec: mujoco.MjSpec, config: MujocoConfig) -> None:
    for name, thing in config.objects.items():
        body = spec.worldbody.add_body(name=name, pos=thing.position)
        body.add_freejoint(name=f"{name}_free")
        boxes = [(thing.size, (0.0, 0.0, 0.0)), *((box.size, box.at) for box in thing.boxes)]
        volume = sum(math.prod(size) for size, _ in boxes)
        for number, (size, at) in enumerate(boxes):
            geom = body.add_geom(
                name=f"{name}_{number}" if number else name,
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=np.array(size) / 2,
                pos=at,
                mass=thing.mass * math.prod(size) / volume,
                rgba=thing.colour,
                group=VISUAL_GROUP,
                condim=4,
                friction=(thing.friction, TORSION, ROLLING),
            )
            # Slippery parts, which slide into each other, get hard contacts. With MuJoCo's usual contacts, light parts
            # would sink in by millimetres.
            if thing.friction < _PAD_FRICTION[0]:
                geom.solref = _PAD_STIFFNESS
