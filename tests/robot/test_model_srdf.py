"""The SRDF files beside the models: those that are shipped are those that the program makes."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from q2r2_control.robot.model_srdf import model_srdfs
from q2r2_control.robot.pairs import CLEARANCE
from tests.robot.conftest import one_arm

SAMPLES = 2000
TOUCH, HAND = "media_flange_touch_pneumatic", {"model": "hand_e"}


def _disabled(text: str) -> set[tuple[str, ...]]:
    return {(element.tag, *element.attrib.values()) for element in ET.fromstring(text)}


@pytest.mark.parametrize("arm", ["iiwa7", "iiwa14"])
def test_every_shipped_file_lists_what_the_program_finds(arm: str) -> None:
    made = model_srdfs(load_config(f"config/dual_{arm}.yaml"), CLEARANCE, SAMPLES)
    assert made.keys() == {f"{arm}.srdf", "hand_e.srdf", f"hand_e_on_{arm}.srdf"}
    for name, text in made.items():
        assert _disabled(text) == _disabled(find_resource(f"robots/{name}").read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize("arm", ["iiwa7", "iiwa14"])
def test_every_shipped_file_about_a_flange_lists_what_the_program_finds(arm: str) -> None:
    gripper = load_config(f"config/dual_{arm}.yaml").arms["left"].gripper.model_dump()  # whose fingers are one body
    cell = one_arm(model=arm, flange={"model": TOUCH}, tool=HAND, gripper=gripper)
    made = model_srdfs(cell, CLEARANCE, SAMPLES)
    assert made.keys() == {f"{arm}.srdf", f"{TOUCH}_on_{arm}.srdf", f"hand_e_on_{TOUCH}_on_{arm}.srdf", "hand_e.srdf"}
    for name, text in made.items():
        assert _disabled(text) == _disabled(find_resource(f"robots/{name}").read_text(encoding="utf-8"))


def test_of_a_flange_without_a_model_no_file_can_speak() -> None:
    with pytest.raises(ConfigError, match=r"arms\.left\.flange: has no model that a file could speak of; --pairs"):
        model_srdfs(one_arm(flange={"thickness": 0.02, "radius": 0.05}), CLEARANCE, SAMPLES)


def test_what_a_file_beside_the_model_says_now_is_not_believed(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_bytes(find_resource("robots/iiwa7.urdf").read_bytes())
    (tmp_path / "arm.srdf").write_text('<robot><disable_default_collisions link="link_0"/></robot>')
    made = model_srdfs(one_arm(model=str(tmp_path / "arm.urdf")), CLEARANCE, SAMPLES)
    assert made.keys() == {"arm.srdf"}
    assert _disabled(made["arm.srdf"]) == _disabled(find_resource("robots/iiwa7.srdf").read_text(encoding="utf-8"))
