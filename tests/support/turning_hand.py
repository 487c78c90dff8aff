"""A hand whose fingers turn as in a Robotiq 2F-85, on both arms of the shipped cell.

The gripper turns the knuckle of each finger by 0.8 rad. The fingertip turns back by the same angle, so that both tips
stay parallel, and a second knuckle turns with the first one. When the hand closes, the tips move 14 mm away from the
palm. The axes are taken from the published drawings of the 2F-85. The shapes are simple, and have about the size of the
2F-85.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.enclose import enclose_shapes
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

CLOSED, OPEN = 0.8, 0.0  # [rad]
_TABLE = 0.2  # Height of the table's top [m].
_FRAME_TO_OPEN_TIPS = 0.0107  # Distance from the tool frame to the tips of the open hand [m].
# The angle of each other joint, as a multiple of the drive joint's angle.
_FOLLOWERS = {"one_tip": -1.0, "one_inner": 1.0, "two_knuckle": 1.0, "two_tip": -1.0, "two_inner": 1.0}


def _shape(xyz: str, rpy: str, radius: float, length: float) -> str:
    geometry = f'<geometry><cylinder radius="{radius}" length="{length}"/></geometry>'
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/>{geometry}</collision>'


def _joint(name: str, parent: str, child: str, origin: str) -> str:
    share = _FOLLOWERS.get(name.removesuffix("_joint"))
    mimic = "" if share is None else f'<mimic joint="drive" multiplier="{share}"/>'
    limits = 'lower="-0.8" upper="0"' if share == -1.0 else 'lower="0" upper="0.8"'
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin {origin}/>'
        f'<axis xyz="1 0 0"/><limit {limits} velocity="2" effort="50"/>{mimic}</joint>'
    )


def _finger(side: str, y: float, yaw: float, drive: str) -> str:
    knuckle, inner = (f'xyz="0 {y * at} {z}" rpy="0 0 {yaw}"' for at, z in ((0.0306, 0.0549), (0.0127, 0.0614)))
    return (
        f'<link name="{side}_knuckle">{_shape("0 0.0345 0.0195", "0.1 0 0", 0.008, 0.04)}</link>'
        f'<link name="{side}_tip">{_shape("0 -0.006 0.02", "0 0 0", 0.009, 0.05)}</link>'
        f'<link name="{side}_inner">{_shape("0 0.02 0.02", "-0.75 0 0", 0.006, 0.045)}</link>'
        + _joint(drive, "palm", f"{side}_knuckle", knuckle)
        + _joint(f"{side}_tip_joint", f"{side}_knuckle", f"{side}_tip", 'xyz="0 0.0376 0.043"')
        + _joint(f"{side}_inner_joint", "palm", f"{side}_inner", inner)
    )


def hand_urdf() -> str:
    """Return the URDF of the hand as a tool. The tool frame is between the tips."""
    return (
        f'<robot name="turning_hand"><link name="palm">{_shape("0 0 0.045", "0 0 0", 0.035, 0.05)}</link>'
        + _finger("one", -1.0, np.pi, "drive")
        + _finger("two", 1.0, 0.0, "two_knuckle_joint")
        + '<link name="frame"/><joint name="to_frame" type="fixed"><parent link="palm"/><child link="frame"/>'
        '<origin xyz="0 0 0.14"/></joint></robot>'
    )


def turning_cell(folder: Path, **obstacles: object) -> Config:
    """Return the shipped cell with this hand on both arms. The hand's model is written to ``folder``."""
    model = folder / "turning_hand.urdf"
    model.write_text(hand_urdf(), encoding="utf-8")
    data = load_config("config/dual_iiwa7.yaml").model_dump()
    for arm in data["arms"].values():
        arm["tool"] = {"model": str(model), "frame": "frame"}
        arm["gripper"] |= {"joints": ("drive",), "open_position": OPEN, "closed_position": CLOSED, "speed": 1.5}
    data["obstacles"] |= obstacles
    return Config.model_validate(data)


def above_table(tips: float) -> pin.SE3:
    """Return a pose of the left tool, which points down. Its open tips are ``tips`` [m] above the table."""
    return pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi), np.array([0.5, 0.25, _TABLE + _FRAME_TO_OPEN_TIPS + tips]))


class RealHands:
    """The shapes of both hands, posed by the URDF for one opening. They do not include the space that fingers sweep."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._model = robot, pin.buildModelFromXML(robot.urdf)
        geometry = pin.buildGeomFromUrdfString(self._model, robot.urdf, pin.GeometryType.COLLISION)
        enclose_shapes(geometry)
        self.geometry, self._data = geometry, self._model.createData()
        for name in robot.collision_model.collisionPairs:
            pair = [robot.collision_model.geometryObjects[i].name for i in (name.first, name.second)]
            geometry.addCollisionPair(pin.CollisionPair(*(geometry.getGeometryId(each) for each in pair)))
        self._geometry_data = geometry.createData()

    def _posture(self, q: Array, openings: Mapping[str, float]) -> Array:
        full = np.zeros(self._model.nq)
        for name, value in zip(self._robot.joint_names, q, strict=True):
            full[self._model.joints[self._model.getJointId(name)].idx_q] = value
        for arm, opening in openings.items():
            drive = CLOSED + opening * (OPEN - CLOSED)
            turns = {"drive": 1.0} | {f"{link}_joint": share for link, share in _FOLLOWERS.items()}
            for name, share in turns.items():
                full[self._model.joints[self._model.getJointId(f"{arm}_{name}")].idx_q] = share * drive
        return full

    def distances(self, q: Array, openings: Mapping[str, float]) -> Array:
        """Return the distances of all monitored pairs as Coal measures them (pairs,) [m]."""
        full = self._posture(q, openings)
        pin.computeDistances(self._model, self._data, self.geometry, self._geometry_data, full)
        return np.array([result.min_distance for result in self._geometry_data.distanceResults])

    def ends(self, arm: str, name: str, opening: float) -> tuple[Array, float]:
        """Return both ends (2, 3) of a capsule in the frame of the arm's last joint, and its radius [m]."""
        full = self._posture(self._robot.home, {arm: opening})
        pin.forwardKinematics(self._model, self._data, full)
        pin.updateGeometryPlacements(self._model, self._data, self.geometry, self._geometry_data)
        index = self.geometry.getGeometryId(name)
        placement, shape = self._geometry_data.oMg[index], self.geometry.geometryObjects[index].geometry
        last = self._robot.joint_names[int(self._robot.arms[arm].joints[-1])]
        local = self._data.oMi[self._model.getJointId(last)].actInv(placement)
        half = getattr(shape, "halfLength", 0.0) * local.rotation[:, 2]
        return np.array([local.translation - half, local.translation + half]), float(shape.radius)

    @property
    def fingers(self) -> list[str]:
        """Return the geometry names of the left hand's fingers."""
        found = [item.name for item in self.geometry.geometryObjects]
        return [name for name in found if link_of(name).startswith(("left_one_", "left_two_"))]
