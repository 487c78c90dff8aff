"""The first view of the page shows all joints of both arms."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.viewer.web.scene import FIELD_OF_VIEW, first_view


def test_the_first_view_shows_all_joints_inside_a_square_and_the_left_arm_on_the_left(robot: Robot) -> None:
    eye, middle = first_view(robot.model, robot.home)
    forward = (middle - eye) / np.linalg.norm(middle - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    axes = np.array([right, np.cross(right, forward), forward])
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.home)
    across: dict[str, list[float]] = {arm: [] for arm in robot.arms}
    for name, placement in zip(list(robot.model.names)[1:], list(data.oMi)[1:], strict=True):
        x, y, depth = axes @ (placement.translation - eye)
        assert depth > 0.0
        assert max(abs(x), abs(y)) < depth * math.tan(FIELD_OF_VIEW / 2.0), name
        across[name.partition("_")[0]].append(x)
    assert max(across["left"]) < min(across["right"])
