from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from q2r2_control.robot.compose import ComposedCell, compose
from tests.robot.conftest import one_arm

HAND, TOUCH = {"model": "hand_e", "frame": "tool_frame"}, "media_flange_touch_pneumatic"
FINGERS = {"joints": ["finger_joint_1", "finger_joint_2"], "open_position": 0.025}


def test_a_composed_cell_prefixes_names_of_frames_and_joints_with_the_side_of_their_arm(
    dual_iiwa7_cell: ComposedCell,
) -> None:
    cell = dual_iiwa7_cell
    assert cell.tool_frames == {"left": "left_tool_frame", "right": "right_tool_frame"}
    for side in ("left", "right"):
        assert cell.parts.finger_joints[side] == (f"{side}_finger_joint_1", f"{side}_finger_joint_2")
        assert cell.home[f"{side}_finger_joint_1"] == 0.025
    assert cell.obstacles == ("table",)


def test_every_link_joint_shape_and_material_has_a_unique_name_even_if_the_model_repeats_names_of_shapes(
    tmp_path: Path,
) -> None:
    text = find_resource("robots/iiwa7.urdf").read_text()
    file = tmp_path / "arm.urdf"
    file.write_text(re.sub(r'<(visual|collision) name="[^"]*"', r'<\1 name="shape"', text))
    root = ET.fromstring(compose(one_arm(model=str(file), tool=HAND)).urdf)
    for path in ("link", "joint", "link/visual", "link/collision", "material"):
        names = [element.get("name") for element in root.findall(path)]
        assert None not in names
        assert len(names) == len(set(names)) > 0, path


def test_mounts_and_obstacles_stand_where_the_config_puts_them() -> None:
    mount, tool = {"position": [1, 2, 3], "rpy": [0, math.pi, 0]}, HAND | {"mount": {"position": [0, 0, 0.1]}}
    post = {"shape": "cylinder", "size": [0.1, 2], "position": [4, 5, 6]}
    data = one_arm(mount=mount, tool=tool).model_dump() | {"obstacles": {"post": post}}
    cell = compose(Config.model_validate(data))
    model = pin.buildModelFromXML(cell.urdf)
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    tool = data.oMf[model.getFrameId("left_tool_frame", pin.FrameType.BODY)]
    np.testing.assert_allclose(tool.translation, [1, 2, 3 - 1.266 - 0.1 - 0.1435], atol=1e-9)
    np.testing.assert_allclose(data.oMf[model.getFrameId("post", pin.FrameType.BODY)].translation, [4, 5, 6])


def test_undriven_joints_are_fixed_but_a_finger_that_mimics_a_driven_finger_moves_with_it() -> None:
    panda = {"model": "example-robot-data:panda", "home": [0, 0, 0, -1, 0, 1, 0]}
    cell = compose(one_arm(**panda))
    assert cell.tool_frames == {"left": "left_panda_hand_tcp"}
    arm = [f"left_panda_joint{number}" for number in range(1, 8)]
    assert list(cell.home) == list(pin.buildModelFromXML(cell.urdf).names)[1:] == arm
    moved = compose(one_arm(**panda, gripper={"joints": ["panda_finger_joint1"], "open_position": 0.04}))
    assert moved.parts.finger_joints == {"left": ("left_panda_finger_joint1",)}
    assert moved.home["left_panda_finger_joint2"] == 0.04


def test_pairs_of_tool_and_arm_are_excluded_only_if_the_tool_is_mounted_directly_on_the_flange() -> None:
    flat = compose(one_arm(tool=HAND)).srdf
    moved = compose(one_arm(tool=HAND | {"mount": {"position": [0, 0, 0.2]}})).srdf
    elsewhere = compose(one_arm(tool=HAND | {"link": "link_3"}, home=[0.0] * 3)).srdf
    assert '"left_link_4" link2="left_hand_e_envelope"' in flat
    assert '"left_link_4" link2="left_hand_e_envelope"' not in moved + elsewhere


@pytest.mark.parametrize(
    ("arm", "line"),
    [
        pytest.param({"model": "iiwa9"}, "arms.left.model = 'iiwa9': robots/iiwa9.urdf: no such file", id="no model"),
        pytest.param({"tool": HAND | {"frame": "tcp"}}, "arms.left.tool.frame = 'tcp'", id="no such tool frame"),
        pytest.param({"tool": HAND | {"link": "elbow"}}, "no such link; allowed: link_0", id="no such carrier"),
        pytest.param({"flange": {"model": "touch"}}, "flange.model = 'touch': robots/touch.urdf: no such", id="flange"),
        pytest.param({"flange": {"model": TOUCH, "frame": "tip"}}, "no such link; allowed: media", id="its frame"),
        pytest.param({"flange": {"model": "iiwa7"}}, "occur in the arm as well", id="a flange with the arm's names"),
        pytest.param({"tool": {"frame": "link_0"}}, "no movable joint", id="a tool frame that nothing moves"),
        pytest.param({"tool": {"model": "iiwa7"}}, "occur in the arm as well", id="a tool with the arm's names"),
        pytest.param({"home": [0] * 6}, "6 value(s), expected 7: A1, A2, A3", id="too few home values"),
        pytest.param({"home": [0, 2.5, *[0] * 5]}, "2.5: joint A2 allows -2.0944 .. 2.0944 rad", id="home outside"),
        pytest.param({"home": [0, 20.0, *[0] * 5]}, "2.0944 rad; 20 degrees are 0.3491 rad", id="home in degrees"),
        pytest.param({"home": [0, 200.0, *[0] * 5]}, "joint A2 allows -2.0944 .. 2.0944 rad", id="home far outside"),
        pytest.param({"gripper": FINGERS}, "no such finger joint; allowed: none", id="fingers without a hand"),
        pytest.param(
            {"tool": HAND, "gripper": FINGERS | {"open_position": 0.05}},
            "arms.left.gripper.open_position = 0.05: joint finger_joint_1 allows 0 .. 0.025",
            id="opened too far",
        ),
    ],
)  # fmt: skip
def test_an_invalid_arm_raises_an_error_of_one_line_with_the_key_and_what_is_allowed(
    arm: dict[str, Any], line: str
) -> None:
    with pytest.raises(ConfigError) as error:
        compose(one_arm(**arm))
    assert line in str(error.value)
    assert "arms.left" in str(error.value)
    assert "\n" not in str(error.value)


def test_one_error_names_all_joints_whose_home_position_is_given_in_degrees() -> None:
    with pytest.raises(ConfigError) as error:
        compose(one_arm(home=[0, 20, 0, -90, 0, 60, 0]))
    named = [fault.partition(" allows")[0] for fault in error.value.faults]
    assert named == [f"arms.left.home[{at}] = {q}: joint A{at + 1}" for at, q in ((1, 20), (3, -90), (5, 60))]


def test_one_error_names_all_joints_of_robot_home_that_are_outside_their_limits() -> None:
    home = {"torso_lift_joint": 2.0, "head_1_joint": 90.0}
    cell = load_config("config/tiago_dual.yaml")
    assert cell.robot is not None
    bent = cell.model_copy(update={"robot": cell.robot.model_copy(update={"home": home})})
    with pytest.raises(ConfigError) as error:
        compose(bent)
    assert [fault.partition(":")[0] for fault in error.value.faults] == [
        "robot.home.torso_lift_joint = 2",
        "robot.home.head_1_joint = 90",
    ]


@pytest.mark.parametrize(
    "name", ["world", "universe", "left_post", "right_", "", "two words", 'a"><link name="b', "ä", "1st", "a\n"]
)
def test_obstacle_names_that_clash_or_would_change_the_xml_are_refused(name: str) -> None:
    data = one_arm().model_dump() | {"obstacles": {name: {"shape": "sphere", "size": [0.1]}}}
    with pytest.raises(ConfigError, match=r"obstacles\..*allowed: letters") as error:
        compose(Config.model_validate(data))
    assert "\n" not in str(error.value)


def test_the_floor_is_its_own_link_with_its_surface_at_the_given_height() -> None:
    cell = compose(one_arm().model_copy(update={"floor": -0.25}))
    model = pin.buildModelFromXML(cell.urdf)
    geometry = pin.buildGeomFromUrdfString(model, cell.urdf, pin.GeometryType.COLLISION)
    floor = geometry.geometryObjects[geometry.getGeometryId("floor_0")]
    assert floor.parentJoint == 0
    assert floor.placement.translation[2] + floor.geometry.halfSide[2] == pytest.approx(-0.25)
    assert min(floor.geometry.halfSide[:2]) > 40.0  # Mounts lie within 20 m of the origin.
    assert cell.obstacles == ()


def test_an_obstacle_may_be_called_floor_only_if_the_cell_has_no_floor() -> None:
    slab = {"floor": {"shape": "box", "size": [2.0, 2.0, 0.1], "position": [0.0, 0.0, -0.05]}}
    data = one_arm().model_dump() | {"obstacles": slab}
    with pytest.raises(ConfigError, match=r"obstacles\.floor: the cell has a floor at z = 0 m; .* or set floor: null"):
        compose(Config.model_validate(data))
    assert compose(Config.model_validate(data | {"floor": None})).obstacles == ("floor",)


def test_a_cell_name_cannot_change_the_xml() -> None:
    quoted = one_arm().model_copy(update={"name": 'a"><link name="b'})
    assert ET.fromstring(compose(quoted).urdf).get("name") == 'a"><link name="b'
    with pytest.raises(ConfigError, match="printable"):
        compose(one_arm().model_copy(update={"name": "a\x00b"}))
