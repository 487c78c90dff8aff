"""The projection to the nullspace moves no tool. An elbow moves to the given posture, and the contract holds."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.control.tasks.frame import tool_jacobian, tool_pose, tools_of
from q2r2_control.control.tasks.posture import project_to_nullspace
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.cells import NAMES, cell, placed

DT = 0.002


@pytest.fixture(scope="module")
def robot() -> Robot:
    return cell("dual_iiwa7").robot


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, ControllerSettings(posture_gain=10.0, posture_speed=1.5))


def swung(robot: Robot, arm: str, way: float) -> Array:
    """Return the home posture with one elbow swung by ``way`` [rad]. To first order, the tool keeps its pose."""
    q, joints = robot.home.copy(), robot.arms[arm].joints
    frame = robot.arms[arm].frame_id
    J = pin.computeFrameJacobian(robot.model, robot.model.createData(), q, frame, pin.LOCAL_WORLD_ALIGNED)
    q[joints] += way * np.linalg.svd(J[:, joints])[2][-1]
    return q


def test_the_elbow_moves_to_the_given_posture_or_home_while_the_tool_stays(
    controller: CartesianController, robot: Robot
) -> None:
    controller.reset(robot.home)
    contract = Contract(controller, robot.home)
    posture, joints = swung(robot, "left", 0.2), robot.arms["left"].joints
    goal = {"left": controller.tool_pose("left")}
    for wanted, near in ((posture, posture), (None, robot.home)):
        for _ in range(1500):
            reference = controller.step(goal, DT, wanted)
            contract.check(reference, DT)
            assert np.linalg.norm(controller.tool_pose("left").translation - goal["left"].translation) < 1e-3
        assert np.abs(reference.q - near)[joints].max() < 0.02
    assert np.abs(posture - robot.home).max() > 0.05


@pytest.mark.parametrize("bad", [np.full(14, np.nan), np.full(14, np.inf), np.zeros(3)], ids=["nan", "inf", "short"])
def test_an_unusable_posture_is_ignored_and_the_last_usable_posture_is_kept(
    controller: CartesianController, robot: Robot, bad: Array
) -> None:
    controller.reset(robot.home)
    goal = {"left": controller.tool_pose("left")}
    posture = swung(robot, "left", 0.2)
    for _ in range(1500):
        controller.step(goal, DT, posture)
    for _ in range(500):
        reference = controller.step(goal, DT, bad)
    assert np.abs(reference.q - posture)[robot.arms["left"].joints].max() < 0.02


def project(J: Array, v: Array) -> None:
    project_to_nullspace(J, np.zeros((len(J), len(J))), np.zeros(len(J)), v)


def test_motion_in_the_nullspace_moves_no_tool() -> None:
    random = np.random.default_rng(27)
    for _ in range(20):
        J = np.zeros((12, 14))
        J[:6, :7], J[6:, 7:] = random.normal(size=(6, 7)), random.normal(size=(6, 7))
        v = random.normal(size=14)
        exact = v - np.linalg.pinv(J) @ J @ v
        project(J, v)
        np.testing.assert_allclose(J @ v, 0.0, atol=1e-4)
        np.testing.assert_allclose(v, exact, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_projected_motion_stays_finite_in_a_stretched_posture(name: str) -> None:
    arrays = cell(name)
    tools, placements = tools_of(arrays.robot), placed(arrays, np.zeros(14)).placements
    J, rotation, translation = np.zeros((12, 14)), np.zeros((3, 3)), np.zeros(3)
    for i in range(2):
        tool_pose(placements, tools, i, rotation, translation)
        tool_jacobian(arrays.collision.chain, placements, tools, i, translation, J[6 * i : 6 * i + 6])
    v = np.full(14, 0.5)
    project(J, v)
    assert np.linalg.norm(v) <= np.linalg.norm(np.full(14, 0.5)) + 1e-9
    np.testing.assert_allclose(J @ v, 0.0, atol=1e-3)
