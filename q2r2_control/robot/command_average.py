"""The moving average that keeps commands within a limit of jerk: its window, and the distance that it needs.

A robot may refuse positions whose acceleration changes too quickly, even if the acceleration itself is allowed. The
accelerations of the controller's reference are at most A, but they may jump. Commands are therefore the mean of
the references of a window W [s] until now.

**Jerk.** The mean of n references in equal periods h changes its acceleration in a period by the difference of two
accelerations of the reference, divided by n. So its jerk is at most 2 A / (n h), and n h >= W = 2 A / j keeps the limit
j.

**Other limits.** Positions, velocities and accelerations of the mean are means of the reference's positions, velocities
and accelerations. If the reference stays within an interval of a joint, so does the mean.

**Distances.** A mean of postures is not a posture of the path, but it is near one. Let the reference be at ``q(c + s)``
at the times of the window around its centre ``c``. The mean of ``q(c + s) - q(c) - s v(c)`` is at most A mean(s^2) / 2,
and the mean of ``s v(c)`` is 0. With n >= 2 references the period is below W, and this bound is at most A W^2 / 8.
Twice this bound is used here, so that ticks may be irregular (``drives/command_average.py``). The reference keeps its
distances at ``c``, also between two ticks. A pair's distance changes by no more than the sum, over the joints, of the
joint's displacement times the distance of the pair's bodies from the joint's axis. The reference therefore keeps the
required distance plus this sum.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.types import Array

# Longest window [s]. Commands are behind the reference by half a window, and a person would feel a longer delay.
LONGEST_WINDOW = 0.05


def average_window(robot: Robot, settings: ControllerSettings) -> float:
    """Return the window of the mean that keeps ``settings.jerk_limit`` [s]; 0 without a limit.

    Raises:
        ConfigError: If the limit has a wrong number of values, or needs a window of more than 50 ms.
    """
    if settings.jerk_limit is None:
        return 0.0
    limit, names = np.atleast_1d(np.asarray(settings.jerk_limit, dtype=np.float64)), robot.joint_names
    if len(limit) not in (1, len(names)):
        raise ConfigError(
            f"control.jerk_limit has {len(limit)} numbers: allowed: one, or {len(names)}, one for each joint: "
            f"{', '.join(names)}"
        )
    windows = np.broadcast_to(2.0 * robot.capped_acceleration(settings.acceleration_limit) / limit, (len(names),))
    joint = int(np.argmax(windows))
    if windows[joint] > LONGEST_WINDOW:
        least = float(2.0 * robot.capped_acceleration(settings.acceleration_limit)[joint] / LONGEST_WINDOW)
        raise ConfigError(
            f"control.jerk_limit = {np.broadcast_to(limit, windows.shape)[joint]:g}: allowed for {names[joint]} with "
            f"its acceleration limit: {least:g} rad/s^3 or more; control.acceleration_limit may be lowered"
        )
    return float(windows[joint])


def average_allowance(robot: Robot, settings: ControllerSettings, geometry: pin.GeometryModel) -> Array:
    """Return how much more distance the reference keeps for each pair of ``geometry`` (p,) [m].

    ``geometry`` begins with the robot's collision model. Raises as :func:`average_window` does.
    """
    window, pairs = average_window(robot, settings), geometry.collisionPairs
    if window == 0.0:
        return np.zeros(len(pairs))
    # Largest distance of the mean from the path, for each joint [rad or m].
    off = 0.25 * window**2 * robot.capped_acceleration(settings.acceleration_limit)
    shift = np.array([_shift(robot, item, off) for item in geometry.geometryObjects])
    return np.array([shift[pair.first] + shift[pair.second] for pair in pairs])


def _shift(robot: Robot, item: pin.GeometryObject, off: Array) -> float:
    """Return the largest distance that a point of a body moves [m], if each joint moves by at most ``off`` (nv,)."""
    model, shape = robot.model, item.geometry
    finger = next((it for it in robot.finger_bodies if isinstance(it, TurningBody) and it.name == item.name), None)
    shape.computeLocalAABB()
    reach = float(np.linalg.norm(item.placement.translation) + np.linalg.norm(shape.aabb_center) + shape.aabb_radius)
    if finger is not None:  # The finger's capsule changes with the opening of the gripper.
        reach = max(reach, finger.extent + finger.radius)
    moved = 0.0
    for joint in reversed(list(model.supports[item.parentJoint])[1:]):
        index = model.joints[joint].idx_v
        slides = model.joints[joint].shortname().startswith("JointModelP")
        if slides:
            reach += float(max(abs(robot.position_lower[index]), abs(robot.position_upper[index])))
        moved += float(off[index]) * (1.0 if slides else reach)
        reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
    return moved
