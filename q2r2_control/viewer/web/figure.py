"""Draw a cell's robot, its collision shapes and moving obstacles in a scene."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
import viser

from q2r2_control.config.moving_obstacle import ObstacleReport
from q2r2_control.robot.obstacle_bodies import body_of
from q2r2_control.types import Array
from q2r2_control.viewer.joint_tree import Colour, JointTree, mesh_of
from q2r2_control.viewer.state_colours import obstacle_colour

_GHOST: Colour = (120, 160, 230)
_CAPSULE: Colour = (200, 110, 40)
_GHOST_OPACITY, _OBSTACLE_OPACITY = 0.35, 0.6


class RobotFigure:
    """The robot in a scene: a node for each joint, with the joint's meshes. A ``ghost`` is translucent."""

    def __init__(self, scene: viser.SceneApi, name: str, tree: JointTree, ghost: bool = False) -> None:
        self._tree, self._data = tree, tree.model.createData()
        self.root = scene.add_frame(name, show_axes=False)
        paths = [name]
        for joint, parent in zip(tree.model.names[1:], [*tree.model.parents][1:], strict=True):
            paths.append(f"{paths[parent]}/{joint}")
        self._frames = [scene.add_frame(path, show_axes=False) for path in paths[1:]]
        for index, (joint, colour, mesh) in enumerate(tree.meshes()):
            if ghost and joint == 0:
                continue  # Shapes without a joint do not move, so the ghost leaves them out.
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
        """Draw the robot in the configuration ``posture`` (nq,)."""
        pin.forwardKinematics(self._tree.model, self._data, posture)
        for frame, placement in zip(self._frames, list(self._data.liMi)[1:], strict=True):
            place(frame, placement)


class CapsuleFigure:
    """The bodies of a collision model, which the controller keeps apart. They are hidden until ``root`` is visible."""

    def __init__(self, scene: viser.SceneApi, name: str, model: pin.GeometryModel) -> None:
        self.root = scene.add_frame(name, show_axes=False, visible=False)
        self._shapes: list[tuple[int, viser.SceneNodeHandle]] = []
        for index, shape in enumerate(model.geometryObjects):
            if (mesh := mesh_of(shape.geometry)) is not None:
                vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
                node = scene.add_mesh_simple(f"{name}/{index}", vertices, faces, color=_CAPSULE, wireframe=True)
                self._shapes.append((index, node))

    def show(self, placed: pin.GeometryData) -> None:
        """Draw all shapes at their poses in ``placed``."""
        for index, node in self._shapes:
            place(node, placed.oMg[index])


class ObstacleFigure:
    """The moving obstacles at their last reported poses."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        self._scene, self._name = scene, name
        # For each obstacle: a tuple of its shape, size and colour; and its node in the scene.
        self._drawn: dict[str, tuple[object, viser.SceneNodeHandle]] = {}

    def show(self, reports: Mapping[str, ObstacleReport]) -> None:
        """Draw the obstacles of ``reports``, and remove all others."""
        for gone in self._drawn.keys() - reports.keys():
            self._drawn.pop(gone)[1].remove()
        for name, report in reports.items():
            body, colour = body_of(name, report.obstacle), obstacle_colour(report)
            looks = report.obstacle.shape, report.obstacle.size, colour
            if name not in self._drawn or self._drawn[name][0] != looks:
                mesh = mesh_of(body.geometry)
                assert mesh is not None
                parts = np.asarray(mesh.vertices), np.asarray(mesh.faces)
                node = self._scene.add_mesh_simple(
                    f"{self._name}/{name}", *parts, color=colour, opacity=_OBSTACLE_OPACITY
                )
                self._drawn[name] = looks, node
            place(self._drawn[name][1], body.placement)


def place(node: viser.SceneNodeHandle, pose: pin.SE3) -> None:
    """Put a node at ``pose`` in its parent's frame."""
    *position, x, y, z, w = pin.SE3ToXYZQUATtuple(pose)
    node.position, node.wxyz = tuple(position), (w, x, y, z)
