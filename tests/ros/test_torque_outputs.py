"""What a torque output sends while nobody knows where the arms are."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.types import RobotState
from tests.ros.conftest import NEEDS_ROS

pytest.importorskip("rclpy", reason=NEEDS_ROS)

from q2r2_control.ros.bridge.torque_outputs import Torques

DT = 0.004


def test_without_a_state_to_trust_the_torque_is_gravitys_alone() -> None:
    config = load_config("config/dual_iiwa7.yaml")
    robot = Robot.from_config(config)
    controller, torques = CartesianController(robot, config.control), Torques(robot, config.impedance)
    zero = np.zeros_like(robot.home)
    state = RobotState(robot.home, zero, zero, None, 0.0)
    torques.reset(state)
    goal = controller.tool_pose("left")
    goal.translation = goal.translation + np.array([0.0, 0.0, 0.05])
    for _ in range(100):  # the arm stays while its reference leaves, and the spring pulls
        reference = controller.step({"left": goal}, DT)
        pulling = torques.step(reference, state, DT, trusted=True)
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), robot.home)
    assert np.abs(pulling - gravity).max() > 10.0
    np.testing.assert_allclose(torques.step(reference, state, DT, trusted=False), gravity, atol=1e-9)
