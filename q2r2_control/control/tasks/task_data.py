"""What the arms are asked to do, and the arrays that the task kernels write anew at each tick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.config.control import EQUAL, ControllerSettings
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.tasks.frame import Motion, Tools, motion_of, tools_of
from q2r2_control.control.tasks.posture import Posture, posture_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


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


def priority_of(robot: Robot, settings: ControllerSettings) -> Priority:
    """The weights of the arms' costs; ``settings.priority`` names an arm, or none."""
    n, nv = len(robot.arms), robot.model.nv
    priority = Priority(np.ones(n), np.full(nv, settings.posture_weight))
    if settings.priority == EQUAL:
        return priority
    first = robot.arms[settings.priority].joints
    for i, (name, arm) in enumerate(robot.arms.items()):
        if name == settings.priority:
            continue
        priority.weight[i] = settings.yield_weight
        # A joint that also moves the arm with priority keeps its full cost.
        priority.posture_weight[np.setdiff1d(arm.joints, first)] = settings.yield_weight * settings.posture_weight
    return priority


class TaskModel(NamedTuple):
    """What does not change in a tick, and between ticks but for gains and weights."""

    chain: Chain
    tools: Tools
    motion: Motion
    posture: Posture
    priority: Priority

    @property
    def live(self) -> tuple[Array, ...]:
        """Gains, speeds and weights, which may change between ticks: whatever is held, kernels read these arrays."""
        return (*self.motion, self.posture.gain, *self.priority)


def task_model_of(robot: Robot, settings: ControllerSettings, chain: Chain) -> TaskModel:
    """The models of all tasks."""
    return TaskModel(
        chain=chain,
        tools=tools_of(robot),
        motion=motion_of(settings),
        posture=posture_of(robot, settings),
        priority=priority_of(robot, settings),
    )


class PoseScratch(NamedTuple):
    """Scratch of an offered pose that is being checked."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    gram: Array  # (3, 3)
    correction: Array  # (3, 3)
    moved: Array  # (6,)


class TaskTargets(NamedTuple):
    """What the arms are asked to do."""

    member: Array  # (n, nv) 1 where a joint is the arm's
    follows: IntArray  # (n,) 1: the tool follows its target, 0: the arm's joints hold
    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) [m]
    feed_forward: Array  # (n, 6) the target's own twist [m/s, rad/s]
    hold: Array  # (nv,) joint positions to hold [rad]
    posture: Array  # (nv,) joint positions that the arms take where the tools leave them free to [rad]
    latched: IntArray  # (n,) 1: the arm has come to rest where it holds
    offered: IntArray  # (n,) what this tick brought: nothing, a pose, something else
    pose: Array  # (n, 4, 4) homogeneous, as offered
    feed_forward_time: float  # in which the feed-forward is smoothed [s]
    teleport_speed: float  # a faster target did not move, it was put elsewhere [m/s]
    teleport_turn: float  # [rad/s]
    scratch: PoseScratch

    @classmethod
    def empty(
        cls, model: TaskModel, feed_forward_time: float, teleport_speed: float, teleport_turn: float
    ) -> TaskTargets:
        n, nv = model.tools.member.shape
        return cls(
            member=model.tools.member,
            follows=np.zeros(n, dtype=np.int64),
            rotation=np.zeros((n, 3, 3)),
            translation=np.zeros((n, 3)),
            feed_forward=np.zeros((n, 6)),
            hold=np.zeros(nv),
            posture=model.posture.home.copy(),
            latched=np.zeros(n, dtype=np.int64),
            offered=np.zeros(n, dtype=np.int64),
            pose=np.zeros((n, 4, 4)),
            feed_forward_time=feed_forward_time,
            teleport_speed=teleport_speed,
            teleport_turn=teleport_turn,
            scratch=PoseScratch(np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(6)),
        )


class TaskData(NamedTuple):
    """Tools at the reference, what they and the posture should do, and the cost that this makes."""

    placements: Placements  # of the joint frames at the reference
    rotation: Array  # (n, 3, 3) of the tools
    translation: Array  # (n, 3) [m]
    J: Array  # (6 n, nv) tool Jacobians, one below the other
    tools_factor: Array  # (6 n, 6 n) Cholesky factor of J J', damped
    tools_moved: Array  # (6 n,) scratch
    twist: Array  # (n, 6) wanted [m/s, rad/s]
    feedback: Array  # (n, 6) the part of it that the error makes
    turn: Array  # (3, 3) scratch: rotation from tool to target
    posture: Array  # (nv,) wanted where the tools leave joints free [rad/s]
    H: Array  # (nv, nv) of the cost 1/2 v' H v + g' v
    g: Array  # (nv,)
    minimum: Array  # (nv,) of that cost without bounds [rad/s]
    factor: Array  # (nv, nv) Cholesky factor of H

    @classmethod
    def empty(cls, model: TaskModel, placements: Placements) -> TaskData:
        n, nv = model.tools.member.shape
        return cls(
            placements=placements,
            rotation=np.zeros((n, 3, 3)),
            translation=np.zeros((n, 3)),
            J=np.zeros((6 * n, nv)),
            tools_factor=np.zeros((6 * n, 6 * n)),
            tools_moved=np.zeros(6 * n),
            twist=np.zeros((n, 6)),
            feedback=np.zeros((n, 6)),
            turn=np.zeros((3, 3)),
            posture=np.zeros(nv),
            H=np.zeros((nv, nv)),
            g=np.zeros(nv),
            minimum=np.zeros(nv),
            factor=np.zeros((nv, nv)),
        )
