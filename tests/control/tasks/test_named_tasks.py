"""Each task that a YAML names reaches its goal, comes to rest, and keeps the contract."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings
from q2r2_control.control.tasks.named_tasks import LookAt, Upright
from q2r2_control.errors import ConfigError
from q2r2_control.types import Array
from tests.control.cells import cell, random_posture
from tests.support.driven import Driven

DOWN = (0.0, 0.0, -1.0)  # The z axis of a tool at home points down, so that its -z axis points up.


def driven(tasks: dict[str, Any], moved: dict[str, pin.SE3] | None = None, **settings: Any) -> Driven:
    """Drive for 5 s towards the start poses of the tools, displaced by ``moved``. Check the contract at every tick."""
    robot = cell("dual_iiwa7").robot
    run = Driven(CartesianController(robot, ControllerSettings(tasks=tasks, **settings)), dt=0.004)
    goals = {
        arm: pin.SE3(by.rotation @ pose.rotation, pose.translation + by.translation)
        for arm, pose in run.start.items()
        for by in [(moved or {}).get(arm, pin.SE3.Identity())]
    }
    run.drive(5.0, goals)
    assert run.contract.tail_acceleration() < 0.1
    return run


def test_a_joint_moves_to_its_position_and_the_tools_stay_where_they_are() -> None:
    robot = cell("dual_iiwa7").robot
    run = driven({"joints": {"positions": {"left_A3": robot.home[2] + 0.3}}})
    assert run.q[2] == pytest.approx(robot.home[2] + 0.3, abs=0.02)
    for arm, start in run.start.items():
        np.testing.assert_allclose(run.controller.tool_pose(arm).translation, start.translation, atol=1e-3)


def test_the_task_look_at_turns_a_tool_towards_a_point_and_does_not_displace_the_tool() -> None:
    point = np.array([0.6, 0.4, 0.1])
    run = driven({"look_at": {"point": point.tolist(), "arms": ["left"]}}, rotation_weights=(0, 0, 0))
    tool = run.controller.tool_pose("left")
    way = point - tool.translation
    assert math.acos(min(tool.rotation[:, 2] @ way / np.linalg.norm(way), 1.0)) < 0.01
    np.testing.assert_allclose(tool.translation, run.start["left"].translation, atol=1e-3)


def test_the_task_upright_keeps_a_tool_near_its_cone_although_the_target_is_tilted_farther() -> None:
    tilted = pin.SE3(pin.exp3(np.array([0.6, 0.0, 0.0])), np.zeros(3))
    run = driven({"upright": {"angle": 0.2, "axis": DOWN, "arms": ["left"]}}, {"left": tilted, "right": tilted})
    lean = {arm: math.acos(run.controller.tool_pose(arm).rotation[:, 2] @ DOWN) for arm in run.start}
    assert 0.2 < lean["left"] < 0.25
    assert lean["right"] == pytest.approx(0.6, abs=1e-3)


def test_the_task_upright_has_no_cost_for_a_tool_within_its_cone() -> None:
    robot = cell("dual_iiwa7").robot
    H, g = Upright(robot, 0.2, axis=DOWN).cost(robot.home, robot.home)
    assert not H.any()
    assert not g.any()


def test_two_tools_keep_their_relative_pose_although_only_one_target_moves() -> None:
    led = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.1])), np.array([0.0, 0.0, 0.08]))
    run = driven({"relative": {"weight": 1000.0}}, {"left": led})
    start = run.start["left"].actInv(run.start["right"])
    now = run.controller.tool_pose("left").actInv(run.controller.tool_pose("right"))
    assert np.linalg.norm(run.controller.tool_pose("left").translation - run.start["left"].translation) > 0.02
    assert np.linalg.norm(start.translation - now.translation) < 1e-3
    assert np.linalg.norm(pin.log3(start.rotation.T @ now.rotation)) < 5e-3


def test_the_task_look_at_reduces_its_error_at_the_rate_of_its_gain_even_while_the_tool_moves() -> None:
    robot, random = cell("dual_iiwa7").robot, np.random.default_rng(5)
    point = np.array([0.5, 0.1, 0.4])

    def error(q: Array) -> float:
        pose = robot.tool_pose(q, "left")
        way = point - pose.translation
        return math.acos(np.clip(pose.rotation[:, 2] @ way / np.linalg.norm(way), -1.0, 1.0))

    for _ in range(20):
        q = random_posture(robot, random)
        if (before := error(q)) > 3.0:
            continue
        H, g = LookAt(robot, point.tolist(), ["left"], gain=4.0).cost(q, q)
        v = -np.linalg.pinv(H, rcond=1e-9) @ g
        assert (error(q + 1e-6 * v) - before) / 1e-6 == pytest.approx(-4.0 * before, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize(
    ("tasks", "told"),
    [
        ({"joints": {"positions": {"left_A9": 0.1}}}, "positions.left_A9: no such joint; allowed: left_A1, left_A2"),
        (
            {"joints": {"positions": {"left_A3": 90}}},
            r"positions.left_A3 = 90: joint left_A3 allows -2.96706 .. 2.96706 rad; 90 degrees are 1.571 rad",
        ),
        ({"joints": {"positions": {"left_A3": math.nan}}}, "left_A3 = nan: joint left_A3 allows -2.96706 .. 2.96706"),
        ({"joints": {"positions": {"left_A3": "up"}}}, r"left_A3 = 'up': allowed: a number \[rad or m\]"),
        ({"joints": {"positions": 3}}, "positions = 3: allowed: positions by joint"),
        ({"joints": {}}, "control.tasks.joints.positions is missing; its settings: positions, gain, weight"),
        ({"look_at": {"point": [0.1, 0.2]}}, r"point = \[0.1, 0.2\]: allowed: three numbers"),
        ({"look_at": {"point": "abc"}}, "point = abc: allowed: three numbers"),
        ({"look_at": {"point": [0.1, 0.2, 0.3], "arms": 3}}, "arms = 3: allowed: a list of some of left, right"),
        ({"look_at": {"point": [0.1, 0.2, 0.3], "arms": ["middle"]}}, "allowed: a list of some of left, right"),
        ({"upright": {"angle": -0.2}}, "angle = -0.2: allowed: a number above 0"),
        ({"upright": {"angle": 20}}, "angle = 20: allowed: a number above 0, at most 3.14 rad"),
        ({"upright": {"angle": 0.2, "axis": [0, 0, 0]}}, "three numbers, not all 0"),
        ({"relative": {"wieght": 1.0}}, "relative.wieght = 1.0: no such setting; its settings: position, rpy, gain"),
    ],
)
def test_the_error_about_a_wrong_setting_says_what_is_allowed(tasks: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        CartesianController(cell("dual_iiwa7").robot, ControllerSettings(tasks=tasks))
