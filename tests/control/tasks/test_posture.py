"""A posture that is given at every tick, as of arms that something else moves: elbows go there, promises stay."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.cells import cell

DT = 0.002


@pytest.fixture(scope="module")
def robot() -> Robot:
    return cell("dual_iiwa7").robot


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, ControllerSettings(posture_gain=10.0, posture_speed=1.5))


def swung(robot: Robot, arm: str, way: float) -> Array:
    """Home with one elbow swung by ``way`` [rad], to first order, which leaves the tool where it is."""
    q, joints = robot.home.copy(), robot.arms[arm].joints
    frame = robot.arms[arm].frame_id
    J = pin.computeFrameJacobian(robot.model, robot.model.createData(), q, frame, pin.LOCAL_WORLD_ALIGNED)
    q[joints] += way * np.linalg.svd(J[:, joints])[2][-1]
    return q


def test_the_elbow_goes_to_the_given_posture_and_home_without_one_while_the_tool_stays(
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
def test_a_posture_that_cannot_be_is_not_used(controller: CartesianController, robot: Robot, bad: Array) -> None:
    controller.reset(robot.home)
    goal = {"left": controller.tool_pose("left")}
    posture = swung(robot, "left", 0.2)
    for _ in range(1500):
        controller.step(goal, DT, posture)
    for _ in range(500):
        reference = controller.step(goal, DT, bad)
    assert np.abs(reference.q - posture)[robot.arms["left"].joints].max() < 0.02


def test_postures_that_leap_anywhere_at_every_tick_break_no_promise(
    controller: CartesianController, robot: Robot
) -> None:
    controller.reset(robot.home)
    contract = Contract(controller, robot.home)
    random = np.random.default_rng(3)
    goal = {arm: controller.tool_pose(arm) for arm in robot.arms}
    for _ in range(3000):
        posture = random.uniform(robot.position_lower, robot.position_upper)
        contract.check(controller.step(goal, DT, posture), DT)
    assert contract.uncertified == 0
