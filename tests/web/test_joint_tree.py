"""The meshes of a robot on a page: grippers and links are drawn, and envelopes are not."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest

from q2r2_control import Robot
from q2r2_control.config.cell_file import load_config
from q2r2_control.viewer.joint_tree import JointTree
from q2r2_control.viewer.shown_robot import ShownRobot
from tests.config.cell_files import CELL

BLACK, STEEL = (31, 31, 33), (158, 163, 168)  # Colours in the gripper's URDF.


@pytest.fixture
def shown() -> ShownRobot:
    config = load_config(CELL)
    return ShownRobot.of(Robot.from_config(config), config)


def colours(shown: ShownRobot, joint: str) -> set[tuple[int, int, int]]:
    tree = JointTree(shown)
    return {colour for index, colour, _ in tree.meshes() if tree.model.names[index] == joint}


def test_a_gripper_is_drawn_without_its_envelope(shown: ShownRobot) -> None:
    assert colours(shown, shown.fingers["left"][0]) == {BLACK, STEEL}
    assert {BLACK, STEEL} < colours(shown, "left_A7")
    assert colours(shown, "left_A7") == colours(shown, "right_A7")
    assert len(colours(shown, "left_A7")) == 4  # These include the colours of the ring and the flange.


def test_for_a_link_without_visual_shapes_its_collision_shape_is_drawn(shown: ShownRobot) -> None:
    urdf = ET.fromstring(shown.urdf)
    for link in urdf.iterfind("link"):
        if link.get("name") == "left_hand_e_base":
            for visual in link.findall("visual"):
                link.remove(visual)
    shown = replace(shown, urdf=ET.tostring(urdf, encoding="unicode"))
    assert len(colours(shown, "left_A7")) == 3  # One of them is the colour of the collision shape.
