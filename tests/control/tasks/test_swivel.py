"""The elbow's swivel: its angle and gradient alone, then the task in the controller."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config, load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.geometry.kinematics import Placements, place
from q2r2_control.control.tasks.swivel import Swivels, SwivelScratch, nearest_along, swivel_angle, swivel_row
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.cells import CellArrays, cell, random_posture
from tests.control.scenarios import SCENARIOS
from tests.control.test_contract import run

ARMS = ("left", "right")


def configured(**swivel: object) -> Config:
    """The shipped cell with both arms' swivel changed."""
    data = load_config("config/dual_iiwa7.yaml").model_dump()
    for arm in ARMS:
        data["arms"][arm]["swivel"] |= swivel
    return Config.model_validate(data)


@cache
def controller_of(angle: float | None) -> CartesianController:
    return CartesianController(Robot.from_config(configured(angle=angle, gain=2.0)))


def swivels_of(arrays: CellArrays) -> Swivels:
    """Both arms' shoulders, elbows and wrists: joints 2, 4 and 6 of each."""
    swivels = Swivels.none(2)
    for i, arm in enumerate(arrays.robot.arms.values()):
        swivels.joint[i] = arm.joints[[1, 3, 5]] + 1
        swivels.along[i] = [nearest_along(arrays.collision.chain, int(joint)) for joint in swivels.joint[i]]
    return swivels


def angle_at(arrays: CellArrays, q: Array, i: int) -> tuple[float, float]:
    placements = Placements.empty(arrays.collision.chain)
    place(arrays.collision.chain, q, placements)
    return swivel_angle(placements, swivels_of(arrays), i, SwivelScratch.empty(2, 14))


def elbow_circle(arrays: CellArrays, q: Array, i: int) -> tuple[Array, Array, Array]:
    """Shoulder, elbow, wrist [m] of an iiwa from Pinocchio: where the axes of A1 and A2, A3 and A4, A5 and A6 meet."""
    model, data = arrays.robot.model, arrays.robot.model.createData()
    pin.forwardKinematics(model, data, q)
    points = []
    for joint in (arrays.robot.arms[ARMS[i]].joints + 1)[[1, 3, 5]]:
        (one, other) = (data.oMi[int(k)] for k in (joint - 1, joint))
        lines = np.stack([one.rotation[:, 2], -other.rotation[:, 2]], axis=1)
        along = np.linalg.lstsq(lines, other.translation - one.translation, rcond=None)[0]
        points.append(one.translation + along[0] * one.rotation[:, 2])
    return points[0], points[1], points[2]


def test_the_angle_is_that_between_the_planes_through_the_line_up_and_to_the_elbow() -> None:
    arrays, random = cell("dual_iiwa7"), np.random.default_rng(31)
    for _ in range(50):
        q = random_posture(arrays.robot, random)
        for i in range(2):
            angle, share = angle_at(arrays, q, i)
            shoulder, elbow, wrist = elbow_circle(arrays, q, i)
            line = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
            across_up, across_elbow = np.cross(line, [0.0, 0.0, 1.0]), np.cross(line, elbow - shoulder)
            cosine = across_up @ across_elbow / np.linalg.norm(across_up) / np.linalg.norm(across_elbow)
            assert np.cos(angle) == pytest.approx(cosine, abs=1e-9)
            # Positive about the line from shoulder to wrist: seen along it, clockwise from up.
            assert np.sign(angle) == np.sign(np.cross(across_up, across_elbow) @ line)
            assert 0.0 < share <= 1.0


@pytest.mark.parametrize("name", ["dual_iiwa7", "dual_panda"])
def test_the_row_is_the_gradient_of_the_angle(name: str) -> None:
    arrays, random, step = cell(name), np.random.default_rng(32), 1e-6
    swivels, placements = swivels_of(arrays), Placements.empty(arrays.collision.chain)
    for _ in range(20):
        q = random_posture(arrays.robot, random)
        place(arrays.collision.chain, q, placements)
        for i in range(2):
            scratch = SwivelScratch.empty(2, 14)
            _, share, size = swivel_row(arrays.collision.chain, placements, swivels, i, scratch)
            differences = np.zeros(14)
            for j in range(14):
                ends = [angle_at(arrays, q + sign * step * np.eye(14)[j], i)[0] for sign in (1, -1)]
                differences[j] = (ends[0] - ends[1] + np.pi) % (2 * np.pi) - np.pi
            assert share > 0.0
            np.testing.assert_allclose(scratch.row / size, differences / (2 * step), atol=1e-4)


@pytest.mark.parametrize(
    "posture",
    [
        pytest.param([0.3, 0.9, 0.2, 0.0, 0.4, 0.0, 0.1], id="stretched out"),
        pytest.param([0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0], id="straight up"),
        pytest.param([0.0, -0.6, 0.0, -1.2, 0.0, 0.3, 0.0], id="wrist above the shoulder"),
    ],
)
def test_where_the_angle_is_not_defined_the_task_is_faded_out_and_finite(posture: list[float]) -> None:
    arrays = cell("dual_iiwa7")
    for offset in (0.0, 1e-12, 1e-6, 1e-3):
        q = arrays.robot.home.copy()
        q[:7] = posture
        q += offset
        placements, scratch = Placements.empty(arrays.collision.chain), SwivelScratch.empty(2, 14)
        place(arrays.collision.chain, q, placements)
        _, share, size = swivel_row(arrays.collision.chain, placements, swivels_of(arrays), 0, scratch)
        assert 0.0 <= share < 0.05
        assert np.isfinite(scratch.row).all()
        assert np.abs(scratch.row).max() < 1.0
        assert size < 0.05


@pytest.mark.parametrize("angle", [-0.6, 0.0, 0.7, None], ids=str)
def test_the_elbow_turns_to_the_angle_while_the_tool_stays(angle: float | None) -> None:
    controller = controller_of(angle)
    robot, arrays = controller.robot, cell("dual_iiwa7")
    controller.reset(robot.home)
    contract = Contract(controller, robot.home)
    start = {arm: controller.tool_pose(arm) for arm in ARMS}
    for _ in range(1200):
        reference = controller.step(start, 0.005)
        contract.check(reference, 0.005)
        for arm, pose in start.items():
            error = controller.tool_pose(arm).actInv(pose)
            assert np.linalg.norm(error.translation) < 1e-4
            assert np.linalg.norm(pin.log3(error.rotation)) < 1e-3
    for i in range(2):
        wanted = angle_at(arrays, robot.home, i)[0] if angle is None else angle
        assert np.degrees(abs(angle_at(arrays, reference.q, i)[0] - wanted)) < 2.0
    assert contract.tail_acceleration() < 0.1
    assert contract.fallbacks == 0


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS.keys())
def test_the_contract_holds_in_every_scenario_with_all_that_shapes_the_posture(scenario: Any) -> None:
    robot = controller_of(0.7).robot
    contract = run(_shaped(robot), scenario, 2.0, 0.005)
    assert contract.fallback_share < 0.01
    assert contract.uncertified == 0


@pytest.mark.parametrize(("name", "duration"), [("crossing", 10.0), ("overhead", 12.0), ("into the table", 4.0)])
def test_held_back_with_all_that_shapes_the_posture_the_arms_come_to_rest(name: str, duration: float) -> None:
    contract = run(_shaped(controller_of(0.7).robot), SCENARIOS[name], duration, 0.005)
    assert contract.tail_acceleration() < 0.1


@cache
def _shaped(robot: Robot) -> CartesianController:
    return CartesianController(robot, ControllerSettings(manipulability_gain=0.5))


def test_only_an_arm_that_has_the_task_turns_its_elbow() -> None:
    data = configured(angle=0.7).model_dump()
    data["arms"]["right"]["swivel"]["gain"] = 2.0
    robot = Robot.from_config(Config.model_validate(data))
    assert robot.arms["left"].swivel is None
    controller = CartesianController(robot)
    controller.reset(robot.home)
    start = {arm: controller.tool_pose(arm) for arm in ARMS}
    for _ in range(600):
        reference = controller.step(start, 0.005)
    np.testing.assert_allclose(reference.q[:7], robot.home[:7], atol=1e-3)
    assert angle_at(cell("dual_iiwa7"), reference.q, 1)[0] == pytest.approx(0.7, abs=0.03)


@pytest.mark.parametrize(
    ("swivel", "says"),
    [
        ({"elbow": "A9"}, "arms.left.swivel.elbow = 'A9': no joint of the arm; allowed: A1, A2, A3, A4, A5, A6, A7"),
        ({"wrist": "finger_joint_1"}, "arms.left.swivel.wrist = 'finger_joint_1': no joint of the arm"),
        ({"shoulder": "A4"}, "arms.left.swivel: expected shoulder, elbow, wrist in the order of the arm's joints"),
    ],
    ids=["no such joint", "a joint of the tool", "elbow and shoulder alike"],
)
def test_joints_that_cannot_be_a_swivel_are_named(swivel: dict[str, str], says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Robot.from_config(configured(gain=1.0, **swivel))
    assert str(caught.value).startswith(says)
