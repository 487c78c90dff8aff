"""The tool frame of each arm, as kernels see it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class Tools(NamedTuple):
    """The tool frame of each arm."""

    joint: IntArray  # (n,) joint that carries it
    rotation: Array  # (n, 3, 3) in the joint's frame
    translation: Array  # (n, 3) [m]
    member: Array  # (n, nv) 1 where a joint moves the tool


def tools_of(robot: Robot) -> Tools:
    """The tool frames of a robot's arms."""
    n, nv = len(robot.arms), robot.model.nv
    tools = Tools(np.zeros(n, dtype=np.int64), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, nv)))
    for i, arm in enumerate(robot.arms.values()):
        frame = robot.model.frames[arm.frame_id]
        tools.joint[i] = frame.parentJoint
        tools.rotation[i] = frame.placement.rotation
        tools.translation[i] = frame.placement.translation
        tools.member[i, arm.joints] = 1.0
    return tools
