"""A cell's robot as a tree of joints with the meshes of its URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping

import coal
import numpy as np
import pinocchio as pin
import trimesh

from q2r2_control.robot.followers import followers_of
from q2r2_control.robot.pairs import ENVELOPE, link_of
from q2r2_control.types import Array
from q2r2_control.viewer.shown_robot import ShownRobot

Colour = tuple[int, int, int]
_SHARP = 0.6  # Edges with a larger angle than this look sharp, and other edges look round [rad].


class JointTree:
    """All movable joints of arms and fingers, and the shapes that each joint moves."""

    def __init__(self, shown: ShownRobot) -> None:
        self.model = pin.buildModelFromXML(shown.urdf)
        self._index = {name: self.model.joints[self.model.getJointId(name)].idx_q for name in self.model.names[1:]}
        self._arms = np.array([self._index[name] for name in shown.joint_names])
        # Indices of the joints of each arm's gripper in the configuration (nq,), and their closed and open positions.
        self._strokes: dict[str, tuple[list[int], float, float]] = {}
        for arm, config in shown.config.arms.items():
            joints = [self._index[name] for name in shown.fingers[arm]]
            self._strokes[arm] = joints, config.gripper.closed_position, config.gripper.open_position
        driven = [joint for joints in shown.fingers.values() for joint in joints]
        followers = followers_of(ET.fromstring(shown.urdf).findall("joint"), driven)
        self._followers = [
            (self._index[name], self._index[one.driver], one)
            for name, one in followers.items()
            if name in self._index and one.driver in self._index
        ]
        visual, solid = (
            pin.buildGeomFromUrdfString(self.model, shown.urdf, kind)
            for kind in (pin.GeometryType.VISUAL, pin.GeometryType.COLLISION)
        )
        drawn = {shape.parentFrame for shape in visual.geometryObjects}
        # For a link without visual shapes, its collision shapes are drawn. Envelopes are not drawn, since they would
        # hide the shapes inside.
        undrawn = (shape for shape in solid.geometryObjects if shape.parentFrame not in drawn)
        self._shapes = [
            *visual.geometryObjects,
            *(shape for shape in undrawn if not link_of(shape.name).endswith(ENVELOPE)),
        ]

    def posture(self, q: Array, openings: Mapping[str, float]) -> Array:
        """Return the configuration (nq,) of all joints.

        Args:
            q: Positions of the arms' joints (nv,) [rad].
            openings: For each arm, the opening of its gripper, from 0 for closed to 1 for open.
        """
        full: Array = pin.neutral(self.model)
        full[self._arms] = q
        for arm, (joints, closed, opened) in self._strokes.items():
            full[joints] = closed + openings.get(arm, 1.0) * (opened - closed)
        for joint, driver, follower in self._followers:
            full[joint] = follower.at(full[driver])
        return full

    def meshes(self) -> Iterator[tuple[int, Colour, trimesh.Trimesh]]:
        """Yield the index of a joint, a colour, and the mesh of all its shapes of this colour, in the joint's frame."""
        found: dict[tuple[int, Colour], list[trimesh.Trimesh]] = {}
        for shape in self._shapes:
            mesh = mesh_of(shape.geometry)
            if mesh is not None:
                mesh.apply_scale(shape.meshScale)
                mesh.apply_transform(shape.placement.homogeneous)
                found.setdefault((shape.parentJoint, colour_of(shape.meshColor)), []).append(mesh)
        for (joint, colour), meshes in found.items():
            yield joint, colour, trimesh.graph.smooth_shade(trimesh.util.concatenate(meshes), angle=_SHARP)


def colour_of(rgba: Array | tuple[float, ...]) -> Colour:
    red, green, blue = (round(255.0 * min(max(float(part), 0.0), 1.0)) for part in rgba[:3])
    return red, green, blue


def mesh_of(geometry: coal.CollisionGeometry) -> trimesh.Trimesh | None:
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
