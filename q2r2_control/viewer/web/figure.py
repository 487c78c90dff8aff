"""A cell's robot as meshes under a frame for each joint, of what the URDF shows."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping

import coal
import numpy as np
import pinocchio as pin
import trimesh
import viser

from q2r2_control.robot.urdf_parts import mimic_of
from q2r2_control.types import Array
from q2r2_control.viewer.web.exchange import PageSetup

Colour = tuple[int, int, int]
_SHARP = 0.6  # an edge, which is not shaded as round [rad]
_GHOST: Colour = (120, 160, 230)
_CAPSULE: Colour = (200, 110, 40)
_GHOST_OPACITY = 0.35


class JointTree:
    """All joints that move, of arms and fingers, and the shapes that each carries."""

    def __init__(self, setup: PageSetup) -> None:
        self.model = pin.buildModelFromXML(setup.urdf)
        self._index = {name: self.model.joints[self.model.getJointId(name)].idx_q for name in self.model.names[1:]}
        self._arms = np.array([self._index[name] for name in setup.joint_names])
        self._strokes: dict[str, tuple[list[int], float, float]] = {}  # of each gripper: joints, closed, open
        for arm, config in setup.config.arms.items():
            joints = [self._index[name] for name in setup.fingers[arm]]
            self._strokes[arm] = joints, config.gripper.closed_position, config.gripper.open_position
        self._mimics = [
            (self._index[joint.get("name", "")], self._index[mimic[0]], *mimic[1:])
            for joint in ET.fromstring(setup.urdf).findall("joint")
            if (mimic := mimic_of(joint)) is not None and joint.get("name") in self._index
        ]
        visual, solid = (
            pin.buildGeomFromUrdfString(self.model, setup.urdf, kind)
            for kind in (pin.GeometryType.VISUAL, pin.GeometryType.COLLISION)
        )
        shown = {shape.parentFrame for shape in visual.geometryObjects}
        # A link that is drawn as nothing is drawn as what may not be touched.
        self._shapes = [
            *visual.geometryObjects,
            *(shape for shape in solid.geometryObjects if shape.parentFrame not in shown),
        ]

    def posture(self, q: Array, openings: Mapping[str, float]) -> Array:
        """Positions (nq,) of all joints: arms at ``q`` (nv,), grippers at their ``openings``, 0 closed .. 1 open."""
        full: Array = pin.neutral(self.model)
        full[self._arms] = q
        for arm, (joints, closed, opened) in self._strokes.items():
            full[joints] = closed + openings.get(arm, 1.0) * (opened - closed)
        for joint, leader, factor, offset in self._mimics:
            full[joint] = factor * full[leader] + offset
        return full

    def meshes(self) -> Iterator[tuple[int, Colour, trimesh.Trimesh]]:
        """Of each joint, by its index, and colour: all shapes in the joint's frame."""
        found: dict[tuple[int, Colour], list[trimesh.Trimesh]] = {}
        for shape in self._shapes:
            mesh = _mesh_of(shape.geometry)
            if mesh is not None:
                mesh.apply_scale(shape.meshScale)
                mesh.apply_transform(shape.placement.homogeneous)
                found.setdefault((shape.parentJoint, colour_of(shape.meshColor)), []).append(mesh)
        for (joint, colour), meshes in found.items():
            yield joint, colour, trimesh.graph.smooth_shade(trimesh.util.concatenate(meshes), angle=_SHARP)


def colour_of(rgba: Array | tuple[float, ...]) -> Colour:
    red, green, blue = (round(255.0 * min(max(float(part), 0.0), 1.0)) for part in rgba[:3])
    return red, green, blue


def _mesh_of(geometry: coal.CollisionGeometry) -> trimesh.Trimesh | None:
    match geometry:
        case coal.Box():
            return trimesh.creation.box(2.0 * geometry.halfSide)
        case coal.Sphere():
            return trimesh.creation.icosphere(2, geometry.radius)
        case coal.Cylinder():
            return trimesh.creation.cylinder(geometry.radius, 2.0 * geometry.halfLength, sections=24)
        case coal.Capsule():
            mesh = trimesh.creation.capsule(2.0 * geometry.halfLength, geometry.radius, count=(16, 16))
            return mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
        case coal.BVHModelBase():
            faces = [[*geometry.tri_indices(index)] for index in range(geometry.num_tris)]
            return trimesh.Trimesh(geometry.vertices(), faces, process=False)
    return None


class RobotFigure:
    """The robot in a scene; a ``ghost`` is translucent."""

    def __init__(self, scene: viser.SceneApi, name: str, tree: JointTree, ghost: bool = False) -> None:
        self._tree, self._data = tree, tree.model.createData()
        self.root = scene.add_frame(name, show_axes=False)
        paths = [name]
        for joint, parent in zip(tree.model.names[1:], [*tree.model.parents][1:], strict=True):
            paths.append(f"{paths[parent]}/{joint}")
        self._frames = [scene.add_frame(path, show_axes=False) for path in paths[1:]]
        for index, (joint, colour, mesh) in enumerate(tree.meshes()):
            if ghost and joint == 0:
                continue  # it does not move
            scene.add_mesh_simple(
                f"{paths[joint]}/shape_{index}",
                np.asarray(mesh.vertices),
                np.asarray(mesh.faces),
                color=_GHOST if ghost else colour,
                opacity=_GHOST_OPACITY if ghost else None,
                cast_shadow=not ghost,
                receive_shadow=not ghost,
            )

    def show(self, posture: Array) -> None:
        """Draw all joints at ``posture`` (nq,)."""
        pin.forwardKinematics(self._tree.model, self._data, posture)
        for frame, placement in zip(self._frames, list(self._data.liMi)[1:], strict=True):
            place(frame, placement)


class CapsuleFigure:
    """The shapes that the controller keeps apart, of a collision model, where ``visible`` lets them be seen."""

    def __init__(self, scene: viser.SceneApi, name: str, model: pin.GeometryModel) -> None:
        self.root = scene.add_frame(name, show_axes=False, visible=False)
        self._shapes: list[tuple[int, viser.SceneNodeHandle]] = []
        for index, shape in enumerate(model.geometryObjects):
            if (mesh := _mesh_of(shape.geometry)) is not None:
                vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
                node = scene.add_mesh_simple(f"{name}/{index}", vertices, faces, color=_CAPSULE, wireframe=True)
                self._shapes.append((index, node))

    def show(self, placed: pin.GeometryData) -> None:
        """Draw all shapes where ``placed`` has them."""
        for index, node in self._shapes:
            place(node, placed.oMg[index])


def place(node: viser.SceneNodeHandle, pose: pin.SE3) -> None:
    """Put a node at ``pose`` in its parent's frame."""
    *position, x, y, z, w = pin.SE3ToXYZQUATtuple(pose)
    node.position, node.wxyz = tuple(position), (w, x, y, z)
