"""What the compiled kernels need to know of a robot and its settings, gathered once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.config.control import EQUAL, ControllerSettings, check_priority
from q2r2_control.control.geometry.collision import CollisionModel, collision_model_of, turning_bodies
from q2r2_control.control.geometry.kinematics import Chain, Placements, place
from q2r2_control.control.geometry.rounded_boxes import deepest, with_rounded_boxes
from q2r2_control.control.safety.joint_limits import JointLimits
from q2r2_control.control.safety.safety_model import Approach, SafetyModel
from q2r2_control.control.tasks.swivel import nearest_along, swivel_angle
from q2r2_control.control.tasks.task_data import SwivelScratch
from q2r2_control.control.tasks.task_model import Motion, Posture, Priority, Swivels, TaskModel, tools_of
from q2r2_control.errors import ConfigError
from q2r2_control.robot.kept_distances import KeptDistances, kept_distances
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# Of pairs that may touch: rows that aim at the very distance would leave the certificate nothing [m].
_LEAST_BUFFER = 0.00025


# How far before contact pairs that may touch are slowed down; bodies are a little larger than what they enclose [m].
_CONTACT_ZONE = 0.002
# Of the depth at which the cores of two bodies meet: as far as they may get into each other.
_DEEPEST = 0.8


class KernelModel(NamedTuple):
    """What does not change in a tick, by the rooms that read it."""

    safety: SafetyModel
    tasks: TaskModel


def kernel_model_of(robot: Robot, settings: ControllerSettings) -> KernelModel:
    """Arrays of a robot's joints, tools, pairs and limits.

    Raises :class:`RobotError` for what no kernel handles, :class:`ConfigError` for a priority that is no arm's name and
    for names of ``settings.pairs`` that no pair has.
    """
    check_priority(settings.priority, tuple(robot.arms))
    safety = _safety_model(robot, settings)
    return KernelModel(safety, _task_model(robot, settings, safety))


def _safety_model(robot: Robot, settings: ControllerSettings) -> SafetyModel:
    kept = kept_distances(robot, settings)
    min_distance = kept.values
    collision = with_rounded_boxes(collision_model_of(robot), -min_distance)
    _check_depths(robot, collision, kept)
    arm = np.full(robot.model.nv, len(robot.arms), dtype=np.int64)
    for i, joints in enumerate(robot.arms.values()):
        arm[joints.joints] = i
    return SafetyModel(
        collision=collision,
        limits=JointLimits(
            lower=robot.position_lower + settings.position_margin,
            upper=robot.position_upper - settings.position_margin,
            velocity=robot.velocity_limit * settings.velocity_scale,
            acceleration=robot.capped_acceleration(settings.acceleration_limit),
            longest_step=settings.max_substep,
            return_speed=settings.recovery_velocity,
        ),
        approach=Approach(
            stop_distance=min_distance + stop_buffer(min_distance, settings),
            gain=np.array([settings.separation_gain]),
            contact_speed=kept.contact_speed,
            contact_zone=np.where(np.isfinite(kept.contact_speed), _CONTACT_ZONE - min_distance, 0.0),
            recovery_speed=settings.separation_recovery_speed,
        ),
        min_distance=min_distance,
        arm=arm,
    )


def _check_depths(robot: Robot, collision: CollisionModel, kept: KeptDistances) -> None:
    """Raises :class:`ConfigError` where two bodies may get so deep into each other that no direction leads out."""
    radius = collision.bodies.radius.copy()
    for number, finger in turning_bodies(robot):
        radius[number] = finger.radius
    allowed = _DEEPEST * deepest(collision, radius)
    for p in np.flatnonzero(-kept.values > allowed):
        names = " and ".join(pair_names(robot.collision_model)[p])
        raise ConfigError(
            f"control.{kept.keys[p]}.depth = {-kept.values[p]:g}: allowed for {names}: up to {allowed[p]:.4f} m"
        )


def stop_buffer(min_distance: Array, settings: ControllerSettings) -> Array:
    """How much farther from each other pairs stop in the QP (p,) [m]."""
    return np.minimum(settings.distance_buffer, np.maximum(0.5 * min_distance, _LEAST_BUFFER))


def _task_model(robot: Robot, settings: ControllerSettings, safety: SafetyModel) -> TaskModel:
    chain, tools = safety.collision.chain, tools_of(robot)
    swivels = _swivels(robot, chain)
    return TaskModel(
        chain=chain,
        tools=tools,
        motion=Motion(
            gain=np.array([settings.position_gain, settings.rotation_gain]),
            deceleration=np.array([settings.linear_deceleration, settings.angular_deceleration]),
            full_speed=np.array([settings.max_linear_speed, settings.max_angular_speed]),
            stretch_gain=np.array([settings.stretch_gain]),
        ),
        posture=Posture(
            home=np.array(robot.home, dtype=np.float64),
            gain=np.array([settings.posture_gain]),
            speed=settings.posture_speed,
        ),
        manipulability_gain=settings.manipulability_gain,
        swivels=swivels,
        has_swivels=int(swivels.gain.any()),
        priority=priority_of(robot, settings),
    )


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


def _swivels(robot: Robot, chain: Chain) -> Swivels:
    """The arms' swivel tasks; without an angle of its own, a task keeps that of the home posture."""
    n, nv = len(robot.arms), robot.model.nv
    swivels, placements, scratch = Swivels.none(n), Placements.empty(chain), SwivelScratch.empty(n, nv)
    place(chain, np.array(robot.home, dtype=np.float64), placements)
    for i, arm in enumerate(robot.arms.values()):
        if arm.swivel is None:
            continue
        swivels.gain[i] = arm.swivel.gain
        for k, name in enumerate((arm.swivel.shoulder, arm.swivel.elbow, arm.swivel.wrist)):
            swivels.joint[i, k] = robot.model.getJointId(name)
            swivels.along[i, k] = nearest_along(chain, int(swivels.joint[i, k]))
        at_home, _ = swivel_angle(placements, swivels, i, scratch)
        swivels.angle[i] = at_home if arm.swivel.angle is None else arm.swivel.angle
    return swivels
