"""Joints that mimic a driver have the right positions in all models of a robot, and limit how far the driver moves."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.errors import RobotError
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.description import joint_limits, parse_urdf
from q2r2_control.robot.followers import Follower, followers_of, with_followers
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.robot.unchecked import unchecked_faults, unchecked_notes
from q2r2_control.viewer.shown_robot import ShownRobot


def joint(name: str, mimic: str = "", limit: str = "0 1", parent: str = "base", kind: str = "revolute") -> str:
    lower, upper = limit.split()
    leader, *numbers = mimic.split()[:3] if mimic else [""]
    multiplier, offset = [*numbers, "1", "0"][:2] if len(numbers) < 2 else numbers
    follows = f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>' if mimic else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{name}_link"/>'
        f'<origin xyz="0 0.02 0.1"/><axis xyz="0 1 0"/>{follows}'
        f'<limit lower="{lower}" upper="{upper}" velocity="1" effort="100"/></joint>'
    )


BODY = """<inertial><mass value="0.2"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.01"/></geometry></collision>"""


def model(*joints: str) -> str:
    names = [name for one in joints for name in re.findall(r'<joint name="(\w+)"', one)]
    links = "".join(f'<link name="{name}_link">{BODY}</link>' for name in names)
    return f'<robot name="r"><link name="base">{BODY}</link>{links}{"".join(joints)}</robot>'


def followers(*joints: str, driven: tuple[str, ...] = ()) -> dict[str, Follower]:
    return followers_of(ET.fromstring(model(*joints)).findall("joint"), driven)


CHAIN = (joint("c", "b -2 0.1"), joint("b", "a 0.5 0.2"), joint("a"))


def test_a_joint_that_mimics_a_follower_follows_the_first_driver_for_any_order_of_joints_in_the_file() -> None:
    found = followers(*CHAIN)
    assert found["b"] == Follower("a", 0.5, 0.2)
    assert (found["c"].driver, found["c"].multiplier) == ("a", -1.0)
    assert found["c"].offset == pytest.approx(-0.3)
    positions = with_followers({"a": 0.4}, found)
    assert positions == {"a": 0.4, "b": pytest.approx(0.4), "c": pytest.approx(-2 * 0.4 + 0.1)}


def test_a_joint_with_a_motor_follows_no_other_joint() -> None:
    assert followers(*CHAIN, driven=("b",)) == {"c": Follower("b", -2.0, 0.1)}


def test_a_fixed_joint_follows_no_other_joint() -> None:
    assert followers(joint("b", "a 1 0", kind="fixed"), joint("a")) == {}


@pytest.mark.parametrize(
    ("joints", "complaint"),
    [
        pytest.param((joint("b", "x 1 0"),), "joint b mimics 'x'; allowed: a joint of the model", id="no such joint"),
        pytest.param((joint("a", "a 1 0"),), "joint a mimics a; allowed: mimics that end", id="itself"),
        pytest.param(
            (joint("a", "b 1 0"), joint("b", "c 1 0"), joint("c", "b 1 0")), "joint b mimics c mimics b", id="a circle"
        ),
        pytest.param(
            (joint("b", "a 1 5"), joint("a")),
            "joint b, at 0 .. 1, follows a, at 0 .. 1, by 1 times it and 5, which leaves no way",
            id="no way",
        ),
    ],
)
def test_the_error_about_an_impossible_mimic_names_the_joint(joints: tuple[str, ...], complaint: str) -> None:
    with pytest.raises(RobotError, match=re.escape(complaint)) as error:
        parse_urdf(model(*joints), "arm.urdf")
    assert str(error.value).startswith("arm.urdf: joint")


@pytest.mark.parametrize(
    ("follower", "limits"),
    [
        pytest.param(joint("b", "a 2 0", "0 1"), (0.0, 0.5), id="that is at its end first"),
        pytest.param(joint("b", "a -1 0", "-0.3 0"), (0.0, 0.3), id="the other way"),
        pytest.param(joint("b", "a 1 0.5", "0 1"), (0.0, 0.5), id="with an offset"),
        pytest.param(joint("b", "a 0.5 0", "0 1"), (0.0, 1.0), id="that has room to spare"),
        pytest.param(joint("b", "a 0 0.5", "0 1"), (0.0, 1.0), id="that stands still"),
        pytest.param(joint("c", "b -2 0", "-1 0") + joint("b", "a 1 0"), (0.0, 0.5), id="of a follower"),
        pytest.param(joint("b", "a -1 0", "0 0.8"), (0.0, 0.8), id="whose range has the wrong sign"),
    ],
)
def test_a_driver_moves_only_as_far_as_its_followers_limits_allow(follower: str, limits: tuple[float, float]) -> None:
    root = parse_urdf(model(joint("a"), follower), "arm.urdf")
    found = {one.get("name"): joint_limits(one) for one in root.findall("joint")}
    assert found["a"] == pytest.approx(limits)
    for name, one in followers_of(root.findall("joint")).items():
        for end in found["a"]:
            assert found[name][0] - 1e-9 <= one.at(end) <= found[name][1] + 1e-9


ROTOR = '<joint name="b" type="continuous"><parent link="base"/><child link="b_link"/><axis xyz="0 0 1"/>{}</joint>'


@pytest.mark.parametrize("multiplier", [100.0, -2.0])
def test_a_continuous_follower_does_not_limit_the_range_of_its_driver(multiplier: float) -> None:
    follower = ROTOR.format(f'<mimic joint="a" multiplier="{multiplier}"/>')
    text = ET.tostring(parse_urdf(model(joint("a", limit="-2.9 2.9"), follower), "arm.urdf"))
    for root in (ET.fromstring(text), parse_urdf(text, "written again")):
        (driver,) = (one for one in root.findall("joint") if one.get("name") == "a")
        assert joint_limits(driver) == (-2.9, 2.9)


HAND = (
    joint("finger", limit="0 0.6", parent="j3_link"),
    joint("tip", "middle 0.5 0.1", "-2 2", parent="middle_link"),
    joint("middle", "finger -1 0", "-1 0.1", parent="finger_link"),
)
ARM = (joint("j1", limit="-2 2"), *(joint(f"j{n}", limit="-2 2", parent=f"j{n - 1}_link") for n in (2, 3)))


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """Return an arm of three joints with a hand. Its joint tip follows joint middle, which follows joint finger."""
    file = tmp_path_factory.mktemp("hand") / "arm.urdf"
    file.write_text(model(*ARM, *HAND))
    gripper = {"joints": ["finger"], "open_position": 0.5, "closed_position": 0.0}
    arm = {"model": str(file), "tip": "j3_link", "home": [0.3, 0.4, 0.5], "gripper": gripper}
    return Config.model_validate({"name": "cell", "arms": {"left": arm}, "floor": None})


@pytest.mark.parametrize("opening", [0.0, 0.4, 1.0])
def test_in_every_model_a_fingertip_is_at_the_position_that_its_chain_of_mimic_joints_gives(
    cell: Config, opening: float
) -> None:
    joint_tree = pytest.importorskip("q2r2_control.viewer.joint_tree", reason="needs trimesh", exc_type=ImportError)
    robot = Robot.from_config(cell)
    finger = 0.5 * opening
    expected_joints = {"left_finger": finger, "left_middle": -finger, "left_tip": -0.5 * finger + 0.1}
    tree = joint_tree.JointTree(ShownRobot.of(robot, cell))
    q = tree.posture(robot.home, {"left": opening})
    for name, position in expected_joints.items():
        assert q[tree.model.joints[tree.model.getJointId(name)].idx_q] == pytest.approx(position)
    data = tree.model.createData()
    pin.forwardKinematics(tree.model, data, q)
    hand, tip = (data.oMi[tree.model.getJointId(f"left_{name}")] for name in ("j3", "tip"))
    at = hand.actInv(tip).translation
    (body,) = (
        one for one in robot.finger_bodies if isinstance(one, TurningBody) and link_of(one.name) == "left_tip_link"
    )
    start, end, radius = body.capsule((opening, opening))
    along = np.clip((at - start) @ (end - start) / max(float((end - start) @ (end - start)), 1e-12), 0.0, 1.0)
    assert np.linalg.norm(at - start - along * (end - start)) <= radius - 0.01 + 1e-6


def test_a_simulated_fingertip_starts_at_the_position_that_its_chain_of_mimic_joints_gives(cell: Config) -> None:
    robot = Robot.from_config(cell)
    plant = MujocoPlant(robot, cell)
    try:
        found = {name: float(plant.data.joint(f"left_{name}").qpos[0]) for name in ("finger", "middle", "tip")}
    finally:
        plant.close()
    assert found == pytest.approx({"finger": 0.5, "middle": -0.5, "tip": -0.15}, abs=1e-6)


def test_a_bar_that_follows_a_joint_of_an_arm_is_refused_unless_unchecked_links_names_the_bar(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    urdf = model(*ARM, joint("bar", "j2 -1 0", "-2 2", parent="j2_link"))
    says = "bar_link: follows j2 as its joint mimics it, and would be watched where it is at home"
    with pytest.raises(RobotError, match=re.escape(says)):
        Robot.from_urdf(urdf, {"left": "j3_link"})
    assert Robot.from_urdf(urdf, {"left": "j3_link"}, unchecked_links=["bar_link"]).following_links == {
        "bar_link": "j2"
    }
    (file := tmp_path_factory.mktemp("bar") / "arm.urdf").write_text(urdf)
    arm = {"model": str(file), "tip": "j3_link", "home": [0.3, 0.4, 0.5]}
    cell = {"name": "cell", "arms": {"left": arm}}
    (fault,) = unchecked_faults(Robot.from_config(Config.model_validate(cell)))
    assert fault.startswith("left_bar_link: follows left_j2")
    named = Robot.from_config(Config.model_validate(cell | {"unchecked_links": ["left_bar_link"]}))
    assert list(unchecked_notes(named)) == ["unchecked_links: watched only where they are at home: left_bar_link"]
