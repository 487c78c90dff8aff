"""What the compiled kernels need to know of a robot and its settings, gathered once."""

from __future__ import annotations

import numpy as np

from q2r2_control.config.control import EQUAL, ControllerSettings, check_priority
from q2r2_control.control.geometry.collision import Pairs, bodies_of, pairs_of
from q2r2_control.control.geometry.kinematics import Chain, Placements, chain_of, place
from q2r2_control.control.kernel_data import Cell, Limits
from q2r2_control.control.safety.separation_rows import Approach
from q2r2_control.control.tasks.frame import Motion, Tools
from q2r2_control.control.tasks.priority import Priority
from q2r2_control.control.tasks.swivel import Swivels, SwivelScratch, nearest_along, swivel_angle
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


def cell_of(robot: Robot, settings: ControllerSettings) -> Cell:
    """Arrays of a robot's joints, tools, pairs and limits.

    Raises :class:`RobotError` for what no kernel handles, :class:`ConfigError` for a priority that is no arm's name.
    """
    check_priority(settings.priority, tuple(robot.arms))
    chain = chain_of(robot.model)
    bodies = bodies_of(robot.collision_model)
    lower = robot.position_lower + settings.position_margin
    upper = robot.position_upper - settings.position_margin
    pairs = pairs_of(
        robot.collision_model, chain, bodies, np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    )
    tools = tools_of(robot)
    swivels = _swivels(robot, chain)
    return Cell(
        chain=chain,
        bodies=bodies,
        pairs=pairs,
        tools=tools,
        motion=Motion(
            gain=np.array([settings.position_gain, settings.rotation_gain]),
            deceleration=np.array([settings.linear_deceleration, settings.angular_deceleration]),
            full_speed=np.array([settings.max_linear_speed, settings.max_angular_speed]),
            stretch_gain=settings.stretch_gain,
        ),
        approach=Approach(
            stop_distance=settings.min_distance + settings.distance_buffer,
            gain=settings.separation_gain,
            recovery_speed=settings.separation_recovery_speed,
            slow_below=settings.min_distance + settings.distance_buffer + settings.full_speed_distance,
        ),
        priority=_priority(robot, settings),
        swivels=swivels,
        pair_arm=_arms_slowed(robot, pairs, tools.member),
        lower=lower,
        upper=upper,
        velocity=robot.velocity_limit * settings.velocity_scale,
        acceleration=np.full(robot.model.nv, settings.acceleration_limit),
        home=np.array(robot.home, dtype=np.float64),
        limits=Limits(
            longest_step=settings.max_substep,
            min_distance=settings.min_distance,
            return_speed=settings.recovery_velocity,
            contact_speed=settings.contact_speed,
            full_at=settings.full_speed_distance,
            posture_gain=settings.posture_gain,
            posture_speed=settings.posture_speed,
            manipulability_gain=settings.manipulability_gain,
            swivels=int(swivels.gain.any()),
        ),
    )


def tools_of(robot: Robot) -> Tools:
    n, nv = len(robot.arms), robot.model.nv
    tools = Tools(np.zeros(n, dtype=np.int64), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, nv)))
    for i, arm in enumerate(robot.arms.values()):
        frame = robot.model.frames[arm.frame_id]
        tools.joint[i] = frame.parentJoint
        tools.rotation[i] = frame.placement.rotation
        tools.translation[i] = frame.placement.translation
        tools.member[i, arm.joints] = 1.0
    return tools


def _priority(robot: Robot, settings: ControllerSettings) -> Priority:
    n, nv = len(robot.arms), robot.model.nv
    priority = Priority(
        np.ones(n), np.full(nv, settings.posture_weight), np.zeros(n, dtype=np.int64), settings.yield_speed
    )
    if settings.priority == EQUAL:
        return priority
    first = robot.arms[settings.priority].joints
    for i, (name, arm) in enumerate(robot.arms.items()):
        if name == settings.priority:
            priority.pushes[i] = 1
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


def _arms_slowed(robot: Robot, pairs: Pairs, member: Array) -> Array:
    """Which pairs slow which arms: round bodies of two arms, or of an arm and a fixed round body.

    Not two bodies of one arm, its base included: they are near each other in all postures, and would always slow it.
    """
    owned = _owned(robot)
    slowed = np.zeros((len(pairs.first), len(member)))
    for p in range(len(pairs.first)):
        moving = pairs.joint[p][pairs.joint[p] > 0] - 1
        within_one_arm = (owned[pairs.first[p]] & owned[pairs.second[p]]).any()
        if pairs.round[p] and not within_one_arm:
            slowed[p, member[:, moving].any(axis=1)] = 1.0
    return slowed


def _owned(robot: Robot) -> np.ndarray:
    """Which geometries (g, n) belong to which arms: what its joints carry, and what carries its first joint."""
    objects = robot.collision_model.geometryObjects
    owned = np.zeros((len(objects), len(robot.arms)), dtype=bool)
    for i, arm in enumerate(robot.arms.values()):
        joints = {int(index) + 1 for index in arm.joints}
        path, frame = set(), arm.frame_id
        while frame not in path:  # the first frame is its own parent
            path.add(frame)
            frame = robot.model.frames[frame].parentFrame
        owned[:, i] = [item.parentJoint in joints or item.parentFrame in path for item in objects]
    return owned
