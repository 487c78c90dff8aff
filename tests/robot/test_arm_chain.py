"""If the configuration names neither the joints nor the tip of an arm, they are found in the arm's model."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.robot.arm_chain import default_tip, end_of, named_joints
from q2r2_control.robot.description import LinkTree, load_description


def tree(*joints: str) -> LinkTree:
    """Return a model of joints, each given as parent, child, kind (default: fixed) and name (default: to_CHILD)."""
    robot = ET.Element("robot")
    links: dict[str, None] = {}
    for text in joints:
        parent, child, *rest = text.split()
        kind, name = [*rest, *("fixed", f"to_{child}")[len(rest) :]]
        joint = ET.SubElement(robot, "joint", name=name, type=kind)
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        ET.SubElement(joint, "origin", xyz=f"{len(links)} 0 0")  # Every link has its own position.
        links |= {parent: None, child: None}
    for link in links:
        ET.SubElement(robot, "link", name=link)
    return LinkTree(robot, "model")


ARM = ("base one revolute", "one two revolute", "two flange")


@pytest.mark.parametrize(
    ("model", "tip", "joints"),
    [
        pytest.param("iiwa7", "link_ee", 7, id="a flange"),
        pytest.param("example-robot-data:so101", "gripper_frame_link", 5, id="a gripper of one jaw beside its frame"),
        pytest.param("example-robot-data:panda", "panda_hand_tcp", 7, id="a hand of two fingers"),
        pytest.param("example-robot-data:kinova", "j2s6s200_end_effector", 6, id="beside fixed fingers that go deeper"),
        pytest.param("example-robot-data:ur5", "tool0", 6, id="two tool frames at one place"),
        pytest.param("example-robot-data:z1", "gripperStator", 6, id="a gripper whose name is a joint's too"),
        pytest.param("example-robot-data:bravo7_gripper", "grasping_poing", 6, id="beside a sensor and fingers"),
    ],
)
def test_the_chain_of_a_known_arm_is_found(model: str, tip: str, joints: int) -> None:
    known = LinkTree(load_description(model).urdf, model)
    assert default_tip(known, (), "key") == tip
    assert len(known.chain(tip)) == joints


@pytest.mark.parametrize(
    ("more", "tip"),
    [
        pytest.param(["flange antenna_mount", "antenna_mount antenna_tip"], "flange", id="not the antenna's end"),
        pytest.param(["flange ft_sensor", "ft_sensor tool"], "tool", id="the tool behind a sensor"),
        pytest.param(["flange tcp", "flange bracket"], "tcp", id="what is called a tool centre point"),
        pytest.param(["flange jaw_a revolute drive", "flange jaw_b revolute other"], "flange", id="before fingers"),
    ],
)
def test_the_chain_of_an_arm_with_a_side_branch_is_found(more: Sequence[str], tip: str) -> None:
    assert default_tip(tree(*ARM, *more), (), "key") == tip


def test_the_arm_ends_before_a_joint_that_the_gripper_drives_or_that_other_joints_mimic() -> None:
    model = tree(*ARM, "flange hook revolute drive")
    assert default_tip(model, (), "key") == "hook"
    assert default_tip(model, ("drive",), "key") == "flange"
    model = tree(*ARM, "flange left revolute drive", "left far revolute more", "flange right revolute follower")
    ET.SubElement(model.joint_to["right"], "mimic", joint="drive")
    assert default_tip(model, (), "key") == "flange"


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["base other revolute"], "the model's chain branches at base into to_one, to_other: name the arm's last link"),
        (["flange plate", "flange stub"], "the arm could end at plate, stub: name the link that is meant"),
    ],
)
def test_an_ambiguous_chain_is_refused_with_the_possible_tips(more: Sequence[str], says: str) -> None:
    with pytest.raises(ConfigError) as error:
        default_tip(tree(*ARM, *more), (), "key")
    assert str(error.value) == f"key: {says}"


def test_the_end_of_a_tool_is_its_tool_frame_and_not_one_of_its_fingers() -> None:
    tool = LinkTree(load_description("hand_e").urdf, "hand_e")
    assert end_of(tool, tool.root, "key") == "tool_frame"


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["to_three"], "key.joints = 'to_three': no movable joint that carries flange; allowed: to_one, to_two"),
        (["to_flange"], "key.joints = 'to_flange': no movable joint that carries flange; allowed: to_one, to_two"),
        (["to_two", "to_one"], "key.joints = to_two, to_one: expected from base to tip, once each: to_one, to_two"),
        (["to_one", "to_one"], "key.joints = to_one, to_one: expected from base to tip, once each: to_one"),
    ],
)
def test_named_joints_that_are_outside_the_chain_repeated_or_in_another_order_are_refused(
    names: list[str], says: str
) -> None:
    with pytest.raises(ConfigError) as error:
        named_joints(tree(*ARM), "flange", names, "key")
    assert str(error.value) == says
