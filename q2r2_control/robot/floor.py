"""The floor of a cell: its shape in the URDF, and the links that cannot reach it.

The floor is a box whose top is at the floor's height, because URDF has no plane. No arm reaches beyond its edges,
because no mount is farther than 20 m from the origin. The box is thick, so that bodies inside are pushed out through
the top.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.config.arms import PoseConfig
from q2r2_control.errors import ConfigError
from q2r2_control.robot.pairs import CLEARANCE, keep_pairs, link_of
from q2r2_control.robot.urdf_parts import fixed_joint

FLOOR = "floor"  # The name of the floor's link.

_SIZE = (100.0, 100.0, 10.0)  # [m]
_ON = 1e-3  # A box stands on the floor if its underside is not higher above the floor than this [m].
_UPRIGHT = 1e-9  # Greatest sine of the angle to the vertical at which an axis counts as vertical [-].


def floor_link(height: float, parent: str, obstacles: Collection[str]) -> list[ET.Element]:
    """Return the link ``floor`` and the joint that fixes it to ``parent``. Its frame lies in the floor's surface.

    Raises:
        ConfigError: If one of the ``obstacles`` already has this name.
    """
    if FLOOR in obstacles:
        raise ConfigError(
            f"obstacles.{FLOOR}: the cell has a floor at z = {height:g} m; give this another name, or set floor: null"
        )
    link = ET.fromstring(
        f"""<link name="{FLOOR}"><collision name="{FLOOR}_collision"><origin xyz="0 0 {-_SIZE[2] / 2}"/>
        <geometry><box size="{_SIZE[0]} {_SIZE[1]} {_SIZE[2]}"/></geometry></collision></link>"""
    )
    place = PoseConfig(position=(0.0, 0.0, height))
    return [link, fixed_joint(f"{parent}_to_{FLOOR}", parent, FLOOR, place)]


def sink_boxes_into_floor(geometry: pin.GeometryModel) -> None:
    """Extend fixed upright boxes that stand on the floor downwards, so that no body is pushed out at the bottom.

    A body inside a box is pushed out through the nearest face. It cannot leave through the underside of a box on the
    floor. If a gripper were near the underside, and the wrist above the box, the two would be pushed in opposite
    directions, and would never leave the box. The boxes therefore reach deep into the floor. The part of the box above
    the floor does not change.
    """
    floor = next((item for item in geometry.geometryObjects if _is_floor(item)), None)
    if floor is None:
        return
    height = _top(floor)
    for item in geometry.geometryObjects:
        if item is floor or item.parentJoint != 0 or not isinstance(item.geometry, coal.Box):
            continue
        half, centre = item.geometry.halfSide.copy(), item.placement.translation.copy()
        top = centre[2] + half[2]
        if item.placement.rotation[2, 2] < 1.0 - _UPRIGHT or not centre[2] - half[2] - _ON <= height < top:
            continue
        bottom = floor.placement.translation[2] - floor.geometry.halfSide[2]
        item.geometry = coal.Box(2.0 * half[0], 2.0 * half[1], top - bottom)
        item.placement = pin.SE3(item.placement.rotation, np.array([*centre[:2], 0.5 * (top + bottom)]))


def remove_unreachable_floor_pairs(model: pin.Model, geometry: pin.GeometryModel) -> None:
    """Remove each pair of the floor and a body that provably cannot come near to it.

    There are two kinds of such bodies. Some bodies turn about vertical axes only, as the first link of an arm does, and
    keep their height. Other bodies can be tipped by a joint, but stay more than :data:`CLEARANCE` above the floor even
    if they point straight down from this joint.
    """
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    items = {item.name: item for item in geometry.geometryObjects}
    tops = {name: _top(item) for name, item in items.items() if _is_floor(item)}

    def can_meet(a: str, b: str) -> bool:
        surface, body = (a, b) if a in tops else (b, a)
        if surface not in tops:
            return True
        lowest = _lowest(model, data, items[body])
        return lowest is not None and lowest - tops[surface] <= CLEARANCE

    keep_pairs(geometry, can_meet)


def _is_floor(item: pin.GeometryObject) -> bool:
    fixed_box = isinstance(item.geometry, coal.Box) and item.parentJoint == 0
    return fixed_box and link_of(item.name) == FLOOR and bool(item.placement.rotation[2, 2] > 1.0 - _UPRIGHT)


def _top(floor: pin.GeometryObject) -> float:
    """Return the height of the floor's surface [m]."""
    return float(floor.placement.translation[2] + floor.geometry.halfSide[2])


def _lowest(model: pin.Model, data: pin.Data, item: pin.GeometryObject) -> float | None:
    """Return the least height of any point of a capsule or sphere [m]; None if no joint changes its height.

    Joints that turn about vertical axes or slide along level axes do not change heights. Take the first joint of the
    chain that can change a height. The height of its origin is constant, because no joint before it changes heights.
    The bodies that this joint moves always lie in a ball around its origin. ``data`` has the frames and Jacobians at
    the neutral posture.
    """
    height, world_axes = None, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    reach = float(np.linalg.norm(item.placement.translation)) + item.geometry.radius
    reach += getattr(item.geometry, "halfLength", 0.0)
    for joint in list(model.supports[item.parentJoint])[1:]:
        index = model.joints[joint].idx_v
        # The Jacobian of the joint's origin. It is reshaped, because Pinocchio's binding drops the column dimension of
        # a model with one joint.
        twist = np.reshape(pin.getJointJacobian(model, data, joint, world_axes), (6, model.nv))[:, index]
        slides = np.linalg.norm(twist[:3]) > 0.5
        if height is None:
            if (abs(twist[2]) if slides else np.linalg.norm(twist[3:5])) <= _UPRIGHT:
                continue
            height = float(data.oMi[joint].translation[2])
        else:
            reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
        if slides:
            reach += max(abs(model.lowerPositionLimit[index]), abs(model.upperPositionLimit[index]))
    return None if height is None else height - reach
