from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.description import joint_limits, load_description, parse_urdf

GOOD = """<robot name="two">
  <link name="base"/>
  <link name="tip">
    <inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision>
  </link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/>
  </joint>
</robot>"""

ENDS = '<parent link="base"/><child link="tip"/>'


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (GOOD, "", "not XML"),
        (GOOD, "<sdf/>", "<sdf>"),
        ('radius="0.1"', 'radius="nan"', "radius = 'nan'"),
        ('radius="0.1"', 'radius="1_0"', "radius = '1_0'"),  # Only Python accepts this as a number.
        ('radius="0.1"', 'radius="-0.1"', "more than 0"),
        ('xyz="0 0 1"', 'xyz="0 1"', "3 finite number"),
        ('xyz="0 0 1"', 'xyz="0 0 0"', "axis"),
        (
            'lower="-1" upper="1"',
            'lower="1" upper="-1"',
            "joint turn has position limits 1 .. -1; allowed: lower below",
        ),
        ('value="1"', 'value="-1"', "0 or more"),
        ("<axis", '<mimic joint="turn" multiplier="twice"/><axis', "multiplier = 'twice'"),
        ("<sphere", "<ball", "ball"),
        ('<sphere radius="0.1"/>', "", "shapes []"),
        ('link="tip"', 'link="top"', "no child link"),
        ('link="base"', 'link="tip"', "loop"),
        ('name="tip"', 'name="base"', "given twice"),
        ('type="revolute"', 'type="hinge"', "'hinge'"),
        ("</robot>", '<link name="loose"/></robot>', "one root link"),
        ("</robot>", f'<joint name="again" type="fixed">{ENDS}</joint></robot>', "hangs on two joints"),
        ('<sphere radius="0.1"/>', '<mesh filename="package://nowhere/a.stl"/>', "package://nowhere"),
        ("<robot name", '<!DOCTYPE r [<!ENTITY a "aa">]><robot x="&c;" name', "not XML"),
    ],
)
def test_an_invalid_description_raises_an_error_of_one_line(old: str, new: str, complaint: str) -> None:
    with pytest.raises(RobotError) as error:
        parse_urdf(GOOD.replace(old, new), "arm.urdf")
    assert str(error.value).startswith("arm.urdf: ")
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_a_loop_of_two_links_beside_the_tree_of_links_is_refused() -> None:
    loop = "".join(f'<link name="{a}"/>' for a in "ab") + "".join(
        f'<joint name="{a}{b}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>' for a, b in ("ab", "ba")
    )
    with pytest.raises(RobotError, match="loop"):
        parse_urdf(GOOD.replace("</robot>", loop + "</robot>"), "arm.urdf")


def test_a_joint_without_limits_gets_limits_of_two_turns_in_each_direction() -> None:
    endless = GOOD.replace("revolute", "continuous").replace('lower="-1" upper="1" ', "")
    joint = parse_urdf(endless, "arm.urdf").find("joint")
    assert joint is not None
    assert joint.get("type") == "revolute"
    assert joint_limits(joint) == (-4 * math.pi, 4 * math.pi)


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        ("iiwa9", "robots/iiwa7.urdf"),
        ("no/such.urdf", "no such file"),
        ("config/dual_iiwa7.yaml", "neither a name nor a model's file; allowed: a name in robots/, a path"),
        ("robots/iiwa7.srdf", "neither a name nor a model's file; allowed: a name in robots/, a path"),
        ("example-robot-data:pandda", "panda"),
        ("example-robot-data:cassie", "no URDF"),
        ("package://lbr/urdf/iiwa7.urdf", "AMENT_PREFIX_PATH"),
    ],
)
def test_the_error_about_an_unusable_name_of_a_model_says_which_names_are_allowed(model: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        load_description(model)


def test_a_model_of_a_ros_package_and_its_meshes_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    share = tmp_path / "share" / "my_arm"
    share.mkdir(parents=True)
    mesh = share / "tip.stl"
    mesh.write_text("solid")
    (share / "arm.urdf").write_text(
        GOOD.replace('<sphere radius="0.1"/>', '<mesh filename="package://my_arm/tip.stl"/>')
    )
    (share / "arm.srdf").write_text('<robot name="two"/>')
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    description = load_description("package://my_arm/arm.urdf")
    assert [element.get("filename") for element in description.urdf.iter("mesh")] == [str(mesh)]
    assert isinstance(description.srdf, ET.Element)


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(RobotError, match="not XML"):
        load_description(str(tmp_path / "arm.urdf"))
