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


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        pytest.param(GOOD, "", "not XML", id="nothing at all"),
        pytest.param(GOOD, "<sdf/>", "<sdf>", id="another format"),
        pytest.param("</robot>", "", "not XML", id="cut off"),
        pytest.param('radius="0.1"', 'radius="nan"', "radius = 'nan'", id="not a number"),
        pytest.param('radius="0.1"', 'radius="0,1"', "radius = '0,1'", id="a comma for the decimal point"),
        pytest.param('radius="0.1"', 'radius="1_0"', "radius = '1_0'", id="a number to Python only"),
        pytest.param('radius="0.1"', 'radius="-0.1"', "more than 0", id="a negative radius"),
        pytest.param('xyz="0 0 1"', 'xyz="0 1"', "3 finite number", id="a vector of two"),
        pytest.param('xyz="0 0 1"', 'xyz="0 0 0"', "axis", id="an axis without direction"),
        pytest.param('value="1"', 'value="-1"', "0 or more", id="a negative mass"),
        pytest.param(
            "<axis", '<mimic joint="turn" multiplier="twice"/><axis', "multiplier = 'twice'", id="a mimic of no number"
        ),
        pytest.param("<sphere", "<ball", "ball", id="a collision shape that no reader knows"),
        pytest.param('<sphere radius="0.1"/>', "", "shapes []", id="a collision without shape"),
        pytest.param('link="tip"', 'link="top"', "no child link", id="a child that does not exist"),
        pytest.param('link="base"', 'link="tip"', "loop", id="a link that hangs on itself"),
        pytest.param('name="tip"', 'name="base"', "given twice", id="two links of one name"),
        pytest.param('type="revolute"', 'type="hinge"', "'hinge'", id="a joint type that does not exist"),
        pytest.param("</robot>", '<link name="loose"/></robot>', "one root link", id="a link that hangs on nothing"),
        pytest.param(
            "</robot>",
            '<joint name="again" type="fixed"><parent link="base"/><child link="tip"/></joint></robot>',
            "hangs on two joints",
            id="a link with two parents",
        ),
        pytest.param(
            '<sphere radius="0.1"/>',
            '<mesh filename="package://nowhere/a.stl"/>',
            "package://nowhere",
            id="a lost mesh",
        ),
        pytest.param(
            "<robot name",
            '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><robot x="&c;" name',
            "not XML",
            id="entities that are not declared",
        ),
    ],
)
def test_a_description_that_cannot_be_trusted_is_refused_in_one_line(old: str, new: str, complaint: str) -> None:
    with pytest.raises(RobotError) as error:
        parse_urdf(GOOD.replace(old, new), "arm.urdf")
    assert str(error.value).startswith("arm.urdf: ")
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_two_links_that_carry_each_other_beside_the_tree_are_refused() -> None:
    loop = "".join(f'<link name="{a}"/>' for a in "ab") + "".join(
        f'<joint name="{a}{b}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>' for a, b in ("ab", "ba")
    )
    with pytest.raises(RobotError, match="loop"):
        parse_urdf(GOOD.replace("</robot>", loop + "</robot>"), "arm.urdf")


def test_a_joint_without_end_gets_two_turns_each_way() -> None:
    endless = GOOD.replace("revolute", "continuous").replace('lower="-1" upper="1" ', "")
    joint = parse_urdf(endless, "arm.urdf").find("joint")
    assert joint is not None
    assert joint.get("type") == "revolute"
    assert joint_limits(joint) == (-4 * math.pi, 4 * math.pi)


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        pytest.param("iiwa9", "robots/iiwa7.urdf", id="a name that robots/ does not have lists those it has"),
        pytest.param("no/such.urdf", "no such file", id="a path to nothing"),
        pytest.param("example-robot-data:pandda", "panda", id="an unknown example robot lists the known ones"),
        pytest.param("example-robot-data:cassie", "no URDF", id="an example robot that is no URDF"),
        pytest.param("package://lbr/urdf/iiwa7.urdf", "AMENT_PREFIX_PATH", id="a ROS package that is not there"),
        pytest.param("iiwa7.urdf.xacro", "no such file", id="a xacro file that is not there"),
        pytest.param("../../../etc/passwd", "no such file", id="a path out of robots/"),
    ],
)
def test_a_model_that_is_not_there_says_what_is(model: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        load_description(model)


def test_a_model_of_a_ros_package_and_its_meshes_are_found_through_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    with pytest.raises(RobotError, match="cannot be read"):
        load_description(str(tmp_path / "arm.urdf"))
