"""The gradient of manipulability alone, then what it does in the controller."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.control.tasks.manipulability import manipulability_gradient, pull_to_manipulability
from q2r2_control.control.tasks.task_data import TaskData
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.cells import NAMES, cell, kernel_data, kernel_model, random_posture


def jacobian(robot: Robot, q: Array, arm: str) -> Array:
    """Pinocchio's (6, nv), world axes."""
    data = robot.model.createData()
    J = pin.computeFrameJacobian(robot.model, data, q, robot.arms[arm].frame_id, pin.LOCAL_WORLD_ALIGNED)
    return np.ascontiguousarray(J)


def log_manipulability(robot: Robot, q: Array, arm: str, damping: float = 1e-3) -> float:
    scaled = jacobian(robot, q, arm) * np.array([1.0] * 3 + [ROTATION_LENGTH] * 3)[:, None]
    return 0.5 * float(np.linalg.slogdet(scaled @ scaled.T + damping**2 * np.eye(6))[1])


def task_data(name: str, q: Array) -> TaskData:
    """Placements and tool Jacobians at ``q`` (nv,), nothing else."""
    data, robot = kernel_data(name, q).tasks, cell(name).robot
    for i, arm in enumerate(robot.arms):
        data.J[6 * i : 6 * i + 6] = jacobian(robot, q, arm)
    return data


@pytest.mark.parametrize("name", NAMES)
def test_the_gradient_equals_finite_differences(name: str) -> None:
    robot, random, step = cell(name).robot, np.random.default_rng(41), 1e-5
    for _ in range(10):
        q = random_posture(robot, random)
        data = task_data(name, q)
        for i, arm in enumerate(robot.arms):
            manipulability_gradient(kernel_model(name).tasks, data, i)
            differences = [
                (log_manipulability(robot, q + step * row, arm) - log_manipulability(robot, q - step * row, arm))
                / (2 * step)
                for row in np.eye(14)
            ]
            np.testing.assert_allclose(data.manipulability.gradient, differences, rtol=1e-4, atol=1e-5)


def test_where_the_arm_is_stretched_out_the_addition_is_finite_and_bounded() -> None:
    model = kernel_model("dual_iiwa7").tasks._replace(manipulability_gain=10.0)
    for offset in (0.0, 1e-12, 1e-6, 1e-3):
        data = task_data("dual_iiwa7", np.full(14, offset))
        pull_to_manipulability(model, data, 0)
        assert np.isfinite(data.posture).all()
        assert np.abs(data.posture).max() <= model.posture.speed * (1 + 1e-12)
        assert not data.posture[7:].any()


def test_manipulability_rises_while_the_tool_stays() -> None:
    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    reached = {}
    for gain in (0.0, 2.0):
        controller = CartesianController(robot, ControllerSettings(manipulability_gain=gain))
        controller.reset(robot.home)
        contract = Contract(controller, robot.home)
        start = {arm: controller.tool_pose(arm) for arm in robot.arms}
        for _ in range(1000):
            reference = controller.step(start, 0.005)
            contract.check(reference, 0.005)
            for arm, pose in start.items():
                assert np.linalg.norm(controller.tool_pose(arm).translation - pose.translation) < 1e-4
        assert contract.tail_acceleration() < 0.1
        reached[gain] = [log_manipulability(robot, reference.q, arm, 0.0) for arm in robot.arms]
    assert all(more > without + 0.01 for more, without in zip(reached[2.0], reached[0.0], strict=True))
