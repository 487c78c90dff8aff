"""Pairs that are too near at home are named with a change that helps, both for a new robot and for a checked cell."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.errors import RobotError
from q2r2_control.robot.description import load_description
from q2r2_control.supervision.preflight import preflight_faults

NEVER = '<disable_collisions link1="wrist_1_link" link2="wrist_3_link" reason="Never"/>'
KEPT = ControllerSettings.model_validate({"pairs": [{"pair": ("wrist_1_link", "wrist_3_link"), "distance": 0.003}]})


@pytest.fixture(scope="module")
def ur5() -> Path:
    return load_description("example-robot-data:ur5").file


def made(
    file: Path, caplog: pytest.LogCaptureFixture, tools: dict[str, str] | None = None, **options: object
) -> tuple[Robot, list[str]]:
    """Return a robot of this file, and the warnings about it."""
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        shapeless = ("xtion_link", "arm_left_7_link", "arm_right_7_link") if "tiago" in file.name else ()
        robot = Robot.from_urdf(file, tools or {"left": "ee_link"}, unchecked_links=shapeless, **options)  # type: ignore[arg-type]
    return robot, [record.getMessage() for record in caplog.records]


def test_the_warning_names_two_links_that_block_their_own_arm_and_contains_settings_with_which_it_moves(
    ur5: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot, (said,) = made(ur5, caplog)
    assert "wrist_1_link and wrist_3_link are 10.6 mm apart and 10.6 mm at most in 50 other postures" in said
    assert NEVER in said
    assert "home=" not in said, "no other home parts them"
    assert "forearm_link" not in said.partition("to change:")[0], "these overlap by construction"
    errors = []
    for settings in (ControllerSettings(), KEPT):
        controller = CartesianController(robot, settings)
        controller.reset(np.array([0.0, -1.2, 1.5, -0.3, 1.0, 0.0]))
        goal = controller.tool_pose("left") * pin.SE3(np.eye(3), np.array([0.05, 0.05, 0.0]))
        for _ in range(2000):
            controller.step({"left": goal}, 0.001)
        errors.append(np.linalg.norm(controller.tool_pose("left").translation - goal.translation))
    assert errors[1] < 1e-3 < errors[0]


def test_the_warning_contains_python_code_that_prevents_the_warning(
    ur5: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot, (said,) = made(ur5, caplog)
    srdf, settings = said.partition("to change: ")[2].split(", or ")
    assert preflight_faults(robot, ControllerSettings(), None) != ()
    assert preflight_faults(robot, eval(settings), None) == ()
    parted, left = made(ur5, caplog, **eval(f"dict({srdf})"))
    assert (left, preflight_faults(parted, ControllerSettings(), None)) == ([], ())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "tools"),
    [
        ("panda", {"left": "panda_hand"}),
        ("tiago_dual", {"left": "hand_left_grasping_frame", "right": "hand_right_grasping_frame"}),
    ],
)
def test_the_warning_names_two_changes_if_some_pairs_are_too_near_at_home_and_other_pairs_in_all_postures(
    model: str, tools: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    file = load_description(f"example-robot-data:{model}").file
    _, (said,) = made(file, caplog, tools)
    home, srdf = said.partition("to change: ")[2].split(", and for links that hardly part ")
    options: dict[str, object] = eval(f"dict({home}, {srdf})")
    for name, option in options.items():
        assert made(file, caplog, tools, **{name: option})[1] != [], f"{name} is not enough"
    robot, left = made(file, caplog, tools, **options)
    assert left == []
    controller = CartesianController(robot)
    controller.reset(robot.home)
    goals = {arm: controller.tool_pose(arm) * pin.SE3(np.eye(3), np.array([0.05, 0.05, 0.0])) for arm in tools}
    assert not any(controller.step(goals, 0.002).report.fallback for _ in range(750))
    for arm, goal in goals.items():
        assert np.linalg.norm(controller.tool_pose(arm).translation - goal.translation) < 1e-3


def test_an_srdf_that_names_the_pair_prevents_the_warning(ur5: Path, caplog: pytest.LogCaptureFixture) -> None:
    both = NEVER + '<disable_collisions link1="forearm_link" link2="wrist_2_link" reason="Never"/>'
    assert made(ur5, caplog, srdf=f'<robot name="ur5">{both}</robot>')[1] == []


def test_if_other_postures_bring_a_pair_apart_the_warning_about_it_proposes_another_home(
    ur5: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bent = {"elbow_joint": 2.9, "shoulder_lift_joint": -1.2}
    robot, (said,) = made(ur5, caplog, home=bent)
    assert robot.home[1:3].tolist() == [-1.2, 2.9]
    assert "to change: home={'shoulder_pan_joint': " in said
    assert "base_link and wrist_2_link are 10.8 mm apart;" in said
    assert "base_link and forearm_link overlap, and are not watched, though they can part" in said


def test_the_error_that_refuses_a_start_contains_the_lines_that_the_file_of_the_cell_needs(
    ur5: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot, _ = made(ur5, caplog)
    (fault,) = preflight_faults(robot, ControllerSettings(), None)
    assert fault == (
        "home: wrist_1_link_0 and wrist_3_link_0 are 10.6 mm apart; allowed: at least min_distance, 20.0 mm; "
        "they hardly part anywhere; to change: "
        "control: {pairs: [{pair: [wrist_1_link, wrist_3_link], distance: 0.003}]}, "
        f"or a file for srdf, such as q2r2 check --pairs writes, with the line {NEVER}"
    )
    assert preflight_faults(robot, KEPT, None) == ()


@pytest.mark.parametrize(
    ("home", "said"),
    [
        ({"elbow": 0.1}, "home: no joint 'elbow' that moves; joints: shoulder_pan_joint"),
        ({"elbow_joint": 90}, "allows -3.14159 .. 3.14159 rad; 90 degrees are 1.571 rad"),
        ({"elbow_joint": "up"}, "home of elbow_joint = 'up': allowed: a number"),
        ([0.0] * 6, "allowed: positions by joint"),
    ],
)
def test_an_invalid_home_is_refused(ur5: Path, home: object, said: str) -> None:
    with pytest.raises(RobotError, match=r".*") as error:
        Robot.from_urdf(ur5, {"left": "ee_link"}, home=home)  # type: ignore[arg-type]
    assert said in str(error.value)


def test_one_error_names_all_joints_of_a_home_outside_their_limits(ur5: Path) -> None:
    home = {"elbow_joint": 90.0, "wrist_1_joint": 0.0, "wrist_2_joint": -45.0}
    with pytest.raises(RobotError) as error:
        Robot.from_urdf(ur5, {"left": "ee_link"}, home=home)
    named = [fault.partition(" = ")[0].rpartition(" of ")[2] for fault in error.value.faults]
    assert named == ["elbow_joint", "wrist_2_joint"]
