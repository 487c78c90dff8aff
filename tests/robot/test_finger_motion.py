"""Grippers are found by what their joints bring together, whatever these are called."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.robot.description import Description, LinkTree, load_description, parse_urdf
from q2r2_control.robot.finger_motion import FingerMotion
from q2r2_control.robot.model_survey import FoundGripper, check_arm, gripper_of, tip_of, tips_by_side


def box(size: str, at: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>'


def link(name: str, *shapes: str) -> str:
    return f'<link name="{name}">{"".join(shapes)}</link>'


def joint(name: str, parent: str, child: str, at: str, axis: str, limits: str = "-2.9 2.9", more: str = "") -> str:
    kind, (lower, upper) = "prismatic" if more.startswith("slides") else "revolute", limits.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/><limit lower="{lower}" upper="{upper}" velocity="1" effort="9"/>'
        f"{more.removeprefix('slides')}</joint>"
    )


def mimic(leader: str, multiplier: float = 1.0) -> str:
    return f'<mimic joint="{leader}" multiplier="{multiplier}"/>'


UPPER, PALM = box("0.06 0.06 0.2", "0 0 0.1"), box("0.06 0.06 0.04", "0 0 0.03")
ARM = (
    link("base", box("0.1 0.1 0.1")),
    *(link(f"link_{number}", UPPER) for number in (1, 2, 3)),
    joint("j1", "base", "link_1", "0 0 0.1", "0 0 1"),
    joint("j2", "link_1", "link_2", "0 0 0.2", "0 1 0"),
    joint("j3", "link_2", "link_3", "0 0 0.2", "0 1 0"),
    joint("j4", "link_3", "palm", "0 0 0.2", "0 0 1"),
)
PLATE = box("0.01 0.03 0.1", "0 0 0.05")  # It reaches from its link's origin along z.
FIXED_JAW = box("0.01 0.03 0.1", "0.02 0 0.1")
JAW = (link("palm", PALM, FIXED_JAW), link("part", PLATE))
HINGE = joint("j5", "palm", "part", "-0.02 0 0.05", "0 1 0", "-1.2 0.4")
FINGERS = (link("palm", PALM), link("a", PLATE), link("b", PLATE))


def survey(*parts: str) -> tuple[str, FoundGripper | None]:
    """The tip of an arm with these parts, and its gripper."""
    urdf = parse_urdf(f'<robot name="arm">{"".join((*ARM, *parts))}</robot>', "arm.urdf")
    tree = LinkTree(urdf, "arm.urdf")
    motion = FingerMotion(Description(urdf, None, Path("arm.urdf")), tree)
    tip = tip_of(tree, motion, "--left-tip")
    return tip, gripper_of(tree, motion, tip)


def found(*parts: str) -> tuple[str, list[str], float, float]:
    """The tip, and the gripper's joints with the closed and the open position."""
    tip, gripper = survey(*parts)
    assert gripper is not None
    settings = gripper.settings
    return tip, settings["joints"], settings["closed_position"], settings["open_position"]


def test_a_jaw_is_found_by_the_fixed_jaw_that_it_closes_onto_whatever_its_joint_is_called() -> None:
    assert found(*JAW, HINGE) == ("palm", ["j5"], 0.4, -1.2)


def test_drawings_stand_for_shapes_that_a_model_lacks() -> None:
    drawn = [part.replace("collision", "visual") for part in JAW]
    assert found(*drawn, HINGE) == ("palm", ["j5"], 0.4, -1.2)


def test_a_mirrored_jaw_is_closed_at_the_other_end() -> None:
    hinge = joint("j5", "palm", "part", "-0.02 0 0.05", "0 -1 0", "-0.4 1.2")
    assert found(*JAW, hinge) == ("palm", ["j5"], -0.4, 1.2)


def test_fingers_that_slide_apart_are_open_where_they_are_apart() -> None:
    slides = (
        joint("left", "palm", "a", "0.02 0 0.05", "1 0 0", "-0.015 0.03", "slides"),
        joint("right", "palm", "b", "-0.02 0 0.05", "-1 0 0", "-0.015 0.03", "slides"),
    )
    assert found(*FINGERS, *slides) == ("palm", ["left", "right"], -0.015, 0.03)


def test_a_finger_that_follows_another_counts_where_it_is() -> None:
    slides = (
        joint("left", "palm", "a", "0.02 0 0.05", "1 0 0", "-0.015 0.03", "slides"),
        joint("right", "palm", "b", "-0.02 0 0.05", "1 0 0", "-0.03 0.015", "slides" + mimic("left", -1.0)),
    )
    assert found(*FINGERS, *slides) == ("palm", ["left"], -0.015, 0.03)


def test_a_finger_that_has_another_travel_is_named_because_it_stays_still() -> None:
    slides = (
        joint("left", "palm", "a", "0.02 0 0.05", "1 0 0", "-0.015 0.03", "slides"),
        joint("right", "palm", "b", "-0.02 0 0.05", "1 0 0", "-0.03 0.015", "slides"),
    )
    _, gripper = survey(*FINGERS, *slides)
    assert gripper is not None
    assert (gripper.settings["joints"], gripper.others) == (["left"], ("right",))


@pytest.mark.parametrize(
    "wrist",
    [
        pytest.param(joint("gripper_pan", "palm", "part", "0 0 0.05", "0 0 1"), id="it turns about its tool"),
        pytest.param(joint("finger_tilt", "palm", "part", "0 0 0.05", "0 1 0", "-1.2 1.2"), id="it tilts both ways"),
        pytest.param(joint("jaw_tilt", "palm", "part", "0 0 0.05", "0 1 0", "0 2.69"), id="it folds back one way"),
        pytest.param(joint("jaw_tilt", "palm", "part", "0 0 0.05", "0 1 0", "0 1.57"), id="it tilts to one side"),
        pytest.param(joint("thumb", "palm", "part", "0 0 0.05", "0 0 1", "0 0.15", "slides"), id="it slides outwards"),
    ],
)
def test_a_wrist_is_of_the_arm_also_if_it_is_called_like_a_gripper(wrist: str) -> None:
    forearm = box("0.06 0.06 0.12", "0 0 -0.02")  # It reaches back beside the wrist.
    assert survey(link("palm", forearm), link("part", PLATE), wrist) == ("part", None)


def test_a_tool_beside_its_axis_that_turns_onto_the_palm_is_no_jaw() -> None:
    tool, bracket = box("0.02 0.03 0.02", "0.05 0 0.06"), box("0.02 0.03 0.1", "-0.05 0 0.08")
    turn = joint("gripper", "palm", "part", "0 0 0.05", "0 0 1", "0 2.6")
    assert survey(link("palm", PALM, bracket), link("part", tool), turn)[0] == "part"


def test_a_part_that_turns_farther_than_a_jaw_does_is_of_the_arm() -> None:
    assert survey(*JAW, HINGE.replace('lower="-1.2"', 'lower="-2.4"'))[0] == "part"


@pytest.mark.parametrize(("name", "tip"), [("jaw_drive", "palm"), ("j5", "part")])
def test_names_decide_where_there_are_no_shapes(name: str, tip: str) -> None:
    assert survey(link("palm"), link("part"), HINGE.replace("j5", name))[0] == tip


def test_a_hand_without_shapes_is_said_to_be_taken_by_its_joints_alone() -> None:
    turns = [joint(name, "palm", name, "0 0 0.05", "0 1 0", "0 1") for name in ("a", "b")]
    tip, gripper = survey(link("palm"), link("a"), link("b"), *turns)
    assert gripper is not None
    assert (tip, gripper.settings["joints"]) == ("palm", ["a", "b"])
    assert "no shape shows it" in gripper.why


def test_joints_beyond_a_tip_that_bring_nothing_together_are_no_grippers() -> None:
    wrist = joint("j5", "palm", "part", "0 0 0.05", "0 0 1", "-2.9 2.7")
    links = (
        link("palm", PALM, box("0.01 0.01 0.04", "0.03 0.02 0.03")),
        link("part", box("0.01 0.03 0.1", "0.01 0 0.05")),
    )
    urdf = parse_urdf(f'<robot name="arm">{"".join((*ARM, *links, wrist))}</robot>', "a")
    tree = LinkTree(urdf, "arm.urdf")
    gripper = gripper_of(tree, FingerMotion(Description(urdf, None, Path("arm.urdf")), tree), "palm")
    assert gripper is not None
    assert (gripper.settings, gripper.others) == ({}, ("j5",))


BAR = box("0.02 0.02 0.2", "0.06 0 0.1")


def test_a_bar_beside_the_chain_that_follows_a_wrist_is_no_finger_of_a_hand() -> None:
    wrist = (
        joint("j5", "palm", "part", "0 0 0.05", "0 1 0"),
        joint("j6", "part", "flange", "0 0 0.1", "0 0 1"),
        joint("rod", "link_3", "bar", "0.06 0 0", "0 0 1", more=mimic("j4")),
    )
    links = (link("palm", PALM), link("part", PLATE), link("flange", PALM), link("bar", BAR))
    assert survey(*links, *wrist) == ("flange", None)


def test_an_arm_that_goes_on_beyond_a_coupled_joint_is_refused_with_both_joints() -> None:
    parts = (link("palm", PALM), link("part", PLATE), joint("j5", "part", "end", "0 0 0.1", "0 0 1"), link("end", PALM))
    coupled = joint("level", "palm", "part", "0 0 0.05", "0 1 0", more=mimic("j3", -1.0))
    urdf = parse_urdf(f'<robot name="arm">{"".join((*ARM, *parts, coupled))}</robot>', "arm.urdf")
    tree = LinkTree(urdf, "arm.urdf")
    tip = tip_of(tree, FingerMotion(Description(urdf, None, Path("arm.urdf")), tree), "--left-tip")
    with pytest.raises(ConfigError, match=re.escape("level mimics j3, so that it ends the arm")) as error:
        check_arm(tree, tip, "arm.urdf", "--left-tip")
    assert str(error.value).endswith("--left-tip may be palm")
    check_arm(tree, tip, "arm.urdf", None)  # A user who names this tip wants this arm.


def test_an_arm_that_ends_too_early_is_refused_with_links_that_could_be_its_tip() -> None:
    """The last joint of a palletiser is mimicked by a bar as a finger's would be."""
    parts = (
        *(link(f"link_{number}", UPPER) for number in (0, 1, 2, 3)),
        link("bar", BAR),
        joint("j1", "link_0", "link_1", "0 0 0.1", "0 0 1"),
        joint("j2", "link_1", "link_2", "0 0 0.2", "0 1 0"),
        joint("j3", "link_2", "link_3", "0 0 0.2", "0 1 0"),
        joint("rod", "link_2", "bar", "0.06 0 0", "0 1 0", more=mimic("j3")),
    )
    tree = LinkTree(ET.fromstring(f'<robot name="arm">{"".join(parts)}</robot>'), "arm.urdf")
    with pytest.raises(ConfigError, match=r"rod mimics j3, .*; --left-tip may be link_3$"):
        check_arm(tree, "link_2", "arm.urdf", "--left-tip")


@pytest.mark.parametrize(
    ("model", "closed", "opened"),
    [("so100", -0.2, 2.0), ("panda", 0.0, 0.04), ("z1", 0.0, -1.5707), ("talos_arm", -1.0472, 0.0)],
)
def test_of_a_known_gripper_the_open_end_is(model: str, closed: float, opened: float) -> None:
    """At its upper end Talos's fingers are 112 mm apart. Most of them are fixed there in this model."""
    description = load_description(f"example-robot-data:{model}")
    tree = LinkTree(description.urdf, model)
    motion = FingerMotion(description, tree)
    gripper = gripper_of(tree, motion, tip_of(tree, motion, "--left-tip"))
    assert gripper is not None
    ends = gripper.settings["closed_position"], gripper.settings["open_position"]
    assert ends == pytest.approx((closed, opened), abs=1e-4)


def test_a_hand_of_fingers_with_followers_and_a_thumb_without_ends_the_arm() -> None:
    """The <mimic> of this model lack the prefix that its joints have."""
    description = load_description("example-robot-data:alex_psyonic_hands")
    tree = LinkTree(description.urdf, "alex")
    tips = tips_by_side(tree, FingerMotion(description, tree), "--left-tip")
    assert tips == {"left": "LeftPsyonicAbilityBaseLink", "right": "RightPsyonicAbilityBaseLink"}
