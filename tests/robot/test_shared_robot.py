"""Cells whose arms are parts of one robot: Baxter, and TIAGo with two arms on a torso that lifts."""

from __future__ import annotations

import copy
import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from typer.testing import CliRunner

from q2r2_control.cli.app import app
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import load_description
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot

pytestmark = pytest.mark.slow

ARM = ("s0", "s1", "e0", "e1", "w0", "w1", "w2")
LEFT, RIGHT = [f"left_{name}" for name in ARM], [f"right_{name}" for name in ARM]


def _arm(side: str) -> dict[str, Any]:
    finger = f"{side[0]}_gripper_l_finger_joint"
    return {
        "tip": f"{side}_gripper",
        "home": [0.0, -0.7, 0.0, 1.0, 0.0, 1.26, 0.0],
        "gripper": {"joints": [finger], "open_position": 0.02, "closed_position": 0.0},
    }


BAXTER: dict[str, Any] = {
    "name": "baxter",
    "robot": {
        "model": "example-robot-data:baxter",
        "mount": {"position": [0.0, 0.0, 0.93]},
        "home": {"head_pan": 0.3},
    },
    "arms": {side: _arm(side) for side in ("left", "right")},
}
TIAGO: dict[str, Any] = {
    "name": "tiago",
    "robot": {"model": "example-robot-data:tiago_dual", "home": {"torso_lift_joint": 0.2}},
    "srdf": "tiago.srdf",
    "unchecked_links": ["arm_left_7_link", "arm_right_7_link"],
    "arms": {
        side: {"tip": f"hand_{side}_grasping_frame", "home": [0.2, 0.5, 1.5, 1.6, 0.0, 0.0, 0.0]}
        for side in ("left", "right")
    },
}


def _tiago_pairs() -> str:
    """Return an SRDF with pairs that the maker does not list.

    The capsules of forearm and palm overlap, and the capsules of torso and shoulder overlap too.
    """
    hand = ("safety_box", "palm_link", "index_link", "mrl_link", "thumb_link")
    pairs = [(f"arm_{side}_5_link", f"hand_{side}_{part}") for side in ("left", "right") for part in hand]
    pairs += [("torso_lift_link", f"arm_{side}_2_link") for side in ("left", "right")]
    lines = "".join(f'<disable_collisions link1="{a}" link2="{b}" reason="User"/>' for a, b in pairs)
    return f'<robot name="tiago">{lines}</robot>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files of both cells."""
    folder = tmp_path_factory.mktemp("cells")
    for cell in (BAXTER, TIAGO):
        (folder / f"{cell['name']}.yaml").write_text(yaml.safe_dump(cell))
    (folder / "tiago.srdf").write_text(_tiago_pairs())
    return folder


@pytest.fixture(scope="module")
def baxter(folder: Path) -> Robot:
    return Robot.from_config(load_config(folder / "baxter.yaml"))


@pytest.fixture(scope="module")
def tiago(folder: Path) -> Robot:
    return Robot.from_config(load_config(folder / "tiago.yaml"))


def test_the_arms_are_monitored_against_each_other_and_against_the_torso_that_carries_them(baxter: Robot) -> None:
    watched = {frozenset(map(link_of, names)) for names in pair_names(baxter.collision_model)}
    for pair in (
        ("left_gripper_base_link", "right_gripper_base_link"),
        ("left_wrist", "right_upper_forearm"),
        ("l_gripper_l_finger", "right_hand_link"),
        ("left_hand_link", "torso"),
        ("right_upper_forearm", "torso"),
        ("right_gripper_base_link", "pedestal"),
        ("left_lower_forearm", "screen"),
    ):
        assert frozenset(pair) in watched, pair


def test_a_robot_without_an_srdf_monitors_every_pair_that_some_posture_brings_apart() -> None:
    tiago = Robot.from_config(Config.model_validate(TIAGO | {"srdf": None}))
    watched = {frozenset(map(link_of, names)) for names in pair_names(tiago.collision_model)}
    for pair in (("arm_left_5_link", "arm_right_5_link"), ("arm_left_4_link", "torso_lift_link"),
                 ("hand_left_palm_link", "head_2_link"), ("hand_right_palm_link", "base_link")):  # fmt: skip
        assert frozenset(pair) in watched, pair
    random = np.random.default_rng(1)
    postures = [random.uniform(tiago.position_lower, tiago.position_upper) for _ in range(30)]
    assert (np.max([tiago.distance_values(q) for q in postures], axis=0) > 0.0).all()


@pytest.mark.parametrize("name", ["baxter", "tiago"])
def test_the_dynamics_of_a_robot_equal_the_dynamics_of_the_whole_model_with_locked_joints(
    name: str, request: pytest.FixtureRequest
) -> None:
    robot: Robot = request.getfixturevalue(name)
    cell = BAXTER if name == "baxter" else TIAGO
    urdf = ET.tostring(load_description(cell["robot"]["model"]).urdf, encoding="unicode")
    whole = pin.buildModelFromXML(urdf)
    posture = pin.neutral(whole)
    at = cell["robot"]["home"] | ({f"{side}_gripper_l_finger_joint": 0.02 for side in "lr"} if name == "baxter" else {})
    at |= {f"{side}_gripper_r_finger_joint": -0.02 for side in "lr"} if name == "baxter" else {}
    for joint, position in at.items():
        posture[whole.joints[whole.getJointId(joint)].idx_q] = position
    locked = [index for index, joint in enumerate(whole.names) if index and joint not in robot.joint_names]
    expected = pin.buildReducedModel(whole, locked, posture)
    expected.armature[:] = robot.model.armature
    assert tuple(expected.names)[1:] == robot.joint_names
    q = np.random.default_rng(2).uniform(robot.position_lower, robot.position_upper)
    ours, theirs = robot.model.createData(), expected.createData()
    np.testing.assert_allclose(pin.crba(robot.model, ours, q), pin.crba(expected, theirs, q), atol=1e-9)
    np.testing.assert_allclose(
        pin.computeGeneralizedGravity(robot.model, ours, q),
        pin.computeGeneralizedGravity(expected, theirs, q),
        atol=1e-9,
    )
    pin.framesForwardKinematics(expected, theirs, q)
    for side, arm in robot.arms.items():
        tool = theirs.oMf[expected.getFrameId(arm.tool_frame, pin.FrameType.BODY)]
        mount = pin.SE3(np.eye(3), np.array(cell["robot"].get("mount", {}).get("position", [0.0, 0.0, 0.0])))
        np.testing.assert_allclose(robot.tool_pose(q, side).homogeneous, (mount * tool).homogeneous, atol=1e-9)
    np.testing.assert_array_equal(robot.velocity_limit, expected.velocityLimit)
    np.testing.assert_array_equal(robot.torque_limit, expected.effortLimit)


def test_a_joint_that_moves_both_tools_may_be_named_by_only_one_arm() -> None:
    cell = copy.deepcopy(TIAGO) | {"srdf": None, "robot": {"model": "example-robot-data:tiago_dual"}}
    names = [f"arm_left_{number}_joint" for number in range(1, 8)]
    left = cell["arms"]["left"]
    left["joints"], left["home"] = ["torso_lift_joint", *names], [0.1, *left["home"]]
    robot = Robot.from_config(Config.model_validate(cell))
    assert robot.joint_names[0] == "torso_lift_joint"
    assert robot.home[0] == 0.1
    assert all(0 in arm.joints for arm in robot.arms.values())
    right = cell["arms"]["right"]
    right["joints"] = ["torso_lift_joint", *(f"arm_right_{number}_joint" for number in range(1, 8))]
    right["home"] = [0.1, *right["home"]]
    with pytest.raises(ConfigError, match=r"^arms\.right: joint torso_lift_joint is one of arms.left as well"):
        compose(Config.model_validate(cell))


@pytest.mark.parametrize("name", ["baxter", "tiago"])
def test_the_commands_check_and_run_accept_a_cell_whose_arms_are_parts_of_one_robot(name: str, folder: Path) -> None:
    file = str(folder / f"{name}.yaml")
    checked = CliRunner().invoke(app, ["check", file, "--json"])
    assert checked.exit_code == 0, checked.output
    arms = json.loads(checked.stdout)["arms"]
    assert [arm["model"] for arm in arms] == [f"example-robot-data:{name.replace('tiago', 'tiago_dual')}"] * 2
    arguments = ["run", file, "--plant", "mujoco", "--fast", "--duration", "1", "--headless", "--json"]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    summary = json.loads(ran.stdout)
    assert summary["min_distance_mm"] >= 20.0 - 1e-6
    assert all(arm["position_error_mm_rms"] < 20.0 for arm in summary["arms"].values())


def test_if_both_arms_have_the_same_tool_the_names_in_each_tool_get_the_prefix_of_its_arms_side() -> None:
    cell = copy.deepcopy(BAXTER)
    fingers = {"joints": ["finger_joint_1", "finger_joint_2"], "open_position": 0.025}
    for arm in cell["arms"].values():
        arm |= {"tool": {"model": "hand_e"}, "gripper": fingers}
    composed = compose(Config.model_validate(cell))
    assert composed.tool_frames == {"left": "left_tool_frame", "right": "right_tool_frame"}
    assert composed.parts.finger_joints["right"] == ("right_finger_joint_1", "right_finger_joint_2")
    assert set(RIGHT) <= set(composed.home)


def _changed(path: str, value: object) -> Config:
    cell = copy.deepcopy(BAXTER)
    *parents, key = path.split(".")
    place = cell
    for parent in parents:
        place = place.setdefault(parent, {})
    place[key] = value
    if key == "joints" and "tip" in place:
        del place["tip"]
    return Config.model_validate(cell)


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (
            "arms.right.tip",
            "left_gripper",
            "arms.left: every joint that carries left_gripper carries left_gripper of arms.right as well",
        ),
        (
            "arms.right.gripper.joints",
            ["l_gripper_l_finger_joint"],
            "arms.right.gripper.joints = 'l_gripper_l_finger_joint': no such finger joint; allowed: r_gripper",
        ),
        ("arms.right.model", "iiwa7", "arms.right.model: an arm of robot has none; set robot.model"),
        ("robot.home", {"left_s0": 0.1}, "robot.home.left_s0: no joint that rests; allowed: head_pan"),
        ("obstacles", {"torso": {"shape": "sphere", "size": [0.1]}}, "obstacles.torso: the cell has a link of this"),
    ],
)
def test_an_invalid_value_in_a_cell_raises_an_error_of_one_line_that_says_what_is_allowed(
    path: str, value: object, says: str
) -> None:
    with pytest.raises(ConfigError) as error:
        Robot.from_config(_changed(path, value))
    assert says in str(error.value)
    assert "\n" not in str(error.value)
