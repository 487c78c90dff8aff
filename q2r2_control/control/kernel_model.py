"""The arrays of a robot and its settings that compiled kernels read. They are computed once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.config.control import ControllerSettings, check_priority
from q2r2_control.control.geometry.collision import CollisionModel, Pairs, collision_model_of, turning_bodies
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import with_rounded_boxes
from q2r2_control.control.safety.joint_limits import JointLimits
from q2r2_control.control.safety.safety_data import Approach, SafetyData, SafetyModel
from q2r2_control.control.safety.tool_speed import tool_limits_of
from q2r2_control.control.tasks.built_in import TaskData, TaskModel, task_model_of
from q2r2_control.errors import ConfigError
from q2r2_control.robot.kept_distances import KeptDistances, kept_distances
from q2r2_control.robot.obstacle_bodies import with_obstacle_bodies
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# Least buffer of a pair [m]. Without a buffer, the separation rows would let a pair come exactly to its kept distance.
# The certificate could then not prove that the pair keeps this distance.
LEAST_BUFFER = 0.00025
# If the distance of a pair that may touch is below this, the pair is slowed down [m]. A body encloses the real part and
# is slightly larger, so the pair is slow before the real parts touch.
_CONTACT_ZONE = 0.002
# Largest depth by which two bodies may penetrate, as a share of the depth at which their cores meet.
_DEEPEST = 0.8


class KernelModel(NamedTuple):
    """Data that do not change within a tick. Each field is named after the package that reads it."""

    safety: SafetyModel
    tasks: TaskModel


def kernel_model_of(robot: Robot, settings: ControllerSettings) -> KernelModel:
    """Return the arrays of a robot's joints, tools, pairs and limits.

    Raises:
        RobotError: If the kernels cannot handle a joint or the shape of a body.
        ConfigError: If the priority is not the name of an arm, or if a name in ``settings.pairs`` belongs to no pair.
    """
    check_priority(settings.priority, tuple(robot.arms))
    kept, geometry = kept_distances(robot, settings), with_obstacle_bodies(robot, settings.moving_obstacles)
    more = len(geometry.collisionPairs) - len(kept.values)
    # These pairs do not count yet, because no object is held and no obstacle is known.
    min_distance = np.append(kept.values, np.full(more, -np.inf))
    contact_speed = np.append(kept.contact_speed, np.full(more, np.inf))
    depth = np.append(-kept.values, np.zeros(more))
    collision = with_rounded_boxes(collision_model_of(robot, geometry), depth)
    _check_depths(robot, collision, kept)
    arm = np.full(robot.model.nv, len(robot.arms), dtype=np.int64)
    for i, joints in enumerate(robot.arms.values()):
        arm[joints.joints] = i
    safety = SafetyModel(
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
            contact_speed=contact_speed,
            contact_zone=np.where(np.isfinite(contact_speed), _CONTACT_ZONE - min_distance, 0.0),
            recovery_speed=settings.separation_recovery_speed,
        ),
        min_distance=min_distance,
        arm=arm,
        of_two_arms=_of_two_arms(collision.pairs),
        tools=tool_limits_of(robot, collision.chain, settings.tool_speed_limit),
    )
    return KernelModel(safety, task_model_of(robot, settings, collision.chain))


def _of_two_arms(pairs: Pairs) -> IntArray:
    """Return an array (p,): 1 if both bodies of a pair move and no joint moves both, otherwise 0."""
    own = (pairs.carried == 0) & (pairs.sign > 0).any(axis=1) & (pairs.sign < 0).any(axis=1)
    return own.astype(np.int64)


def _check_depths(robot: Robot, collision: CollisionModel, kept: KeptDistances) -> None:
    """Raise :class:`ConfigError` if two bodies may penetrate so deeply that their cores may meet.

    If the cores met, the direction in which the bodies separate would be unknown.
    """
    radius = collision.bodies.radius.copy()  # The least radius that each body ever has [m].
    for number, finger in turning_bodies(robot):
        radius[number] = finger.radius
    until_cores_meet = radius[collision.pairs.first] + radius[collision.pairs.second]
    allowed = _DEEPEST * until_cores_meet[: len(kept.values)]
    for p in np.flatnonzero(-kept.values > allowed):
        names = " and ".join(pair_names(robot.collision_model)[p])
        raise ConfigError(
            f"control.{kept.keys[p]}.depth = {-kept.values[p]:g}: allowed for {names}: up to {allowed[p]:.4f} m"
        )


def stop_buffer(min_distance: Array, settings: ControllerSettings) -> Array:
    """Return the buffer of each pair (p,) [m]: the QP stops the pair at ``min_distance`` plus this buffer."""
    return np.minimum(settings.distance_buffer, np.maximum(0.5 * min_distance, LEAST_BUFFER))


class KernelData(NamedTuple):
    """Data that change from tick to tick. Each field is named after the package that writes it."""

    safety: SafetyData
    tasks: TaskData

    @classmethod
    def empty(cls, model: KernelModel) -> KernelData:
        """Return arrays of the sizes that ``model`` needs."""
        safety = SafetyData.empty(model.safety)
        return cls(safety, TaskData.empty(model.tasks, safety.collision.placements))
