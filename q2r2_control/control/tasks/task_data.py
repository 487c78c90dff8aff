"""The targets of the arms, the cost of joints that no tool needs, and the data that the task kernels write at each
tick.

For all joints w |v - v_p|^2 with the posture velocity v_p projected into the tools' nullspace, so that at rest it
leaves no tool error. An arm without a target holds its joints by a cost of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.config.control import EQUAL, ControllerSettings
from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.geometry.closest_points import clamp, dot
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.jit import kernel
from q2r2_control.control.tasks.frame import Motion, Tools, tools_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# A held arm is not pushed about by the other one's task, but may give way to recover separation.
_HOLD_WEIGHT = 300.0
HOLD_GAIN = 4.0  # [1/s]
_PROJECTION_DAMPING = 1e-3


class Posture(NamedTuple):
    """Where joints go that the tools leave free."""

    home: Array  # (nv,) [rad]
    gain: Array  # (1,), which may change between ticks [1/s]
    speed: float  # at most [rad/s]


@kernel
def pull_to_posture(model: TaskModel, data: TaskData, targets: TaskTargets, q: Array) -> None:
    """Velocity of every joint from ``q`` (nv,) towards the posture that is asked for, into ``data.posture``."""
    gain, speed = model.posture.gain[0], model.posture.speed
    for j in range(q.shape[0]):
        data.posture[j] = clamp(gain * (targets.posture[j] - q[j]), -speed, speed)


@kernel
def accumulate_hold_cost(data: TaskData, targets: TaskTargets, i: int, q: Array) -> None:
    """Joints of the held arm ``i`` return to where they were latched; the posture pull does not move them."""
    for j in range(q.shape[0]):
        if targets.member[i, j] == 1.0:
            data.H[j, j] += _HOLD_WEIGHT
            data.g[j] -= _HOLD_WEIGHT * HOLD_GAIN * (targets.hold[j] - q[j])
            data.posture[j] = 0.0


@kernel
def accumulate_posture_cost(model: TaskModel, data: TaskData) -> None:
    """Add the cost of all joints' distance from ``data.posture``."""
    for j in range(data.posture.shape[0]):
        weight = model.priority.posture_weight[j]
        data.H[j, j] += weight
        data.g[j] -= weight * data.posture[j]


@kernel
def project_to_nullspace(J: Array, factor: Array, moved: Array, v: Array) -> None:
    """Remove from ``v`` (nv,) what moves the tools with Jacobians J (6n, nv): v -= J' (J J' + d I)^-1 J v.

    ``factor`` (6n, 6n) and ``moved`` (6n,) are scratch.
    """
    for i in range(J.shape[0]):
        for j in range(i, J.shape[0]):
            factor[i, j] = dot(J[i], J[j])
        factor[i, i] += _PROJECTION_DAMPING * _PROJECTION_DAMPING
        moved[i] = dot(J[i], v)
    factorise(factor)  # positive definite for any finite J; of another, J v is not finite either
    substitute(factor, moved)
    for j in range(J.shape[1]):
        for i in range(J.shape[0]):
            v[j] -= J[i, j] * moved[i]


# A target faster than this many times the tool's own limit did not move, it was put elsewhere.
_TELEPORT = 3.0


class Priority(NamedTuple):
    """Which arm gives way where two arms are in each other's way; the weights may change between ticks.

    Arms meet in the QP only where separation rows couple their joints. There all costs of an arm that gives way, also
    posture and damping, are multiplied by a small weight. Its motion then pays for a row that both arms need. Where no
    row is active nothing changes. An arm without a target holds its joints, and does not give way.
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
    """Data that do not change in a tick, and between ticks but for gains and weights."""

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
        motion=Motion(
            gain=np.array([settings.position_gain, settings.rotation_gain]),
            deceleration=np.array([settings.linear_deceleration, settings.angular_deceleration]),
            full_speed=np.array([settings.max_linear_speed, settings.max_angular_speed]),
            stretch_gain=np.array([settings.stretch_gain]),
        ),
        posture=Posture(np.array(robot.home), gain=np.array([settings.posture_gain]), speed=settings.posture_speed),
        priority=priority_of(robot, settings),
    )


class PoseScratch(NamedTuple):
    """Scratch of an offered pose that is being checked."""

    rotation: Array  # (3, 3)
    gram: Array  # (3, 3)
    correction: Array  # (3, 3)
    translation: Array  # (3,)
    moved: Array  # (6,)


class TaskTargets(NamedTuple):
    """The targets of the arms."""

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
    def empty(cls, model: TaskModel, settings: ControllerSettings) -> TaskTargets:
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
            feed_forward_time=settings.feed_forward_time,
            teleport_speed=_TELEPORT * settings.max_linear_speed,
            teleport_turn=_TELEPORT * settings.max_angular_speed,
            scratch=PoseScratch(*np.zeros((3, 3, 3)), *np.zeros((1, 3)), *np.zeros((1, 6))),
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
