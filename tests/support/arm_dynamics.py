"""What tests of torques compute of an arm by Pinocchio alone."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


def left_arm(robot: Robot, q: Array) -> tuple[Array, Array]:
    """Jacobian (6, 7) and inertia (7, 7) of the left arm."""
    data, arm = robot.model.createData(), robot.arms["left"]
    pin.computeJointJacobians(robot.model, data, q)
    J = pin.getFrameJacobian(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, arm.joints]
    return J, pin.crba(robot.model, data, q)[np.ix_(arm.joints, arm.joints)]
