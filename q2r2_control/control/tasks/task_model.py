"""What the task kernels know of a robot and its settings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.kinematics import Chain, IntArray
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class Tools(NamedTuple):
    """The tool frame of each arm."""

    joint: IntArray  # (n,) joint that carries it
    rotation: Array  # (n, 3, 3) in the joint's frame
    translation: Array  # (n, 3) [m]
    member: Array  # (n, nv) 1 where a joint moves the tool


class Motion(NamedTuple):
    """How a tool approaches its target, linear then angular; all of it may change between ticks."""

    gain: Array  # (2,) [1/s]
    deceleration: Array  # (2,) [m/s^2, rad/s^2]
    full_speed: Array  # (2,) [m/s, rad/s]
    stretch_gain: Array  # (1,) k [1/s]


class Posture(NamedTuple):
    """Where joints go that the tools leave free."""

    home: Array  # (nv,) [rad]
    gain: Array  # (1,), which may change between ticks [1/s]
    speed: float  # at most [rad/s]


class Swivels(NamedTuple):
    """The swivel task of each arm. A point is on its joint's axis, ``along`` it from the joint's origin."""

    joint: IntArray  # (n, 3) joints of shoulder, elbow, wrist
    along: Array  # (n, 3) [m]
    angle: Array  # (n,) wanted [rad]
    gain: Array  # (n,) [1/s]; 0: no task

    @classmethod
    def none(cls, n: int) -> Swivels:
        return cls(np.zeros((n, 3), dtype=np.int64), np.zeros((n, 3)), np.zeros(n), np.zeros(n))


class Priority(NamedTuple):
    """Which arm gives way where two arms are in each other's way.

    Arms meet in the QP only where separation rows couple their joints. There the costs decide: all costs of an arm that
    gives way are multiplied by a small weight, so that a row that both arms need is paid for by its motion. Where no
    row is active nothing changes, since the least of a sum of independent costs does not depend on their weights; that
    is why posture and damping are scaled along with the tool's task.

    An arm without a target holds its joints, and holding is never given up: it does not give way. The weights may
    change between ticks.
    """

    weight: Array  # (n,) of an arm's costs while it follows a target: 1, less if it gives way
    posture_weight: Array  # (nv,) the same for each joint, times the posture's own weight


class TaskModel(NamedTuple):
    """What does not change in a tick, and between ticks but for gains and weights."""

    chain: Chain
    tools: Tools
    motion: Motion
    posture: Posture
    manipulability_gain: float  # [rad/s]; 0: off
    swivels: Swivels
    has_swivels: int  # 1: some arm has a swivel task
    priority: Priority


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
