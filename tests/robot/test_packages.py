"""Models whose file names end in .xacro are expanded by the real xacro."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.extras import install_line
from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import load_description

MAIN = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="robot_name" default="lbr"/>
  <xacro:arg name="with_tip" default="false"/>
  <xacro:include filename="$(find my_arm)/urdf/hinge.xacro"/>
  <link name="base"/>
  <xacro:hinge number="1" parent="base"/>
  <xacro:hinge number="2" parent="link_1"/>
  <xacro:if value="$(arg with_tip)">
    <link name="tip"/>
    <joint name="tip_joint" type="fixed"><parent link="link_2"/><child link="tip"/></joint>
  </xacro:if>
</robot>"""
HINGE = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="reach" value="${0.1 * 3}"/>
  <xacro:macro name="hinge" params="number parent">
    <link name="link_${number}"><collision><geometry>
      <mesh filename="package://my_arm/meshes/link.stl"/></geometry></collision></link>
    <joint name="$(arg robot_name)_A${number}" type="revolute"><parent link="${parent}"/><child link="link_${number}"/>
      <origin xyz="0 0 ${reach}"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  </xacro:macro>
</robot>"""
MODEL = "package://my_arm/urdf/arm.urdf.xacro"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a ROS package that is on no search path."""
    package = tmp_path / "checkout" / "description_of_my_arm"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    (package / "urdf" / "arm.urdf.xacro").write_text(MAIN)
    (package / "urdf" / "hinge.xacro").write_text(HINGE)
    (package / "urdf" / "arm.srdf").write_text('<robot name="arm"/>')
    (package / "meshes" / "link.stl").write_text("solid")
    return package


def test_a_cell_that_names_xacro_arguments_and_packages_gets_the_expanded_arm(package: Path, tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(
        "name: cell\npackages: {my_arm: checkout/description_of_my_arm}\narms:\n  left:\n"
        f"    model: {MODEL}\n    xacro_args: {{robot_name: med7, with_tip: true}}\n    home: [0, 0]\n"
    )
    cell = compose(load_config(tmp_path / "cell.yaml"))
    assert list(cell.home) == ["left_med7_A1", "left_med7_A2"]
    assert cell.tool_frames == {"left": "left_tip"}
    assert str(package / "meshes" / "link.stl") in cell.urdf
    assert 'xyz="0 0 0.30000000000000004"' in cell.urdf


def test_xacro_arguments_have_the_defaults_of_the_file_and_an_srdf_in_the_same_folder_is_loaded(package: Path) -> None:
    description = load_description(MODEL, None, {"my_arm": str(package)})
    assert description.name == "arm"
    assert description.urdf.find("link[@name='tip']") is None
    assert description.srdf is not None


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("arm.urdf.xacro", "</robot>", "", "arm.urdf.xacro: xacro cannot expand it: no element found"),
        ("hinge.xacro", "${reach}", "${reech}", "name 'reech' is not defined"),
        ("hinge.xacro", "</robot>", "", "hinge.xacro)"),
        ("arm.urdf.xacro", "my_arm", "your_arm", "package 'your_arm': not found in `packages` of the YAML"),
        ("arm.urdf.xacro", "$(arg with_tip)", "$(arg tip)", "Undefined substitution argument tip"),
        ("hinge.xacro", 'lower="-1"', 'lower="${reach}m"', "<limit> has lower = '0.30000000000000004m'"),
    ],
)
def test_a_model_that_xacro_cannot_expand_raises_an_error_of_one_line(
    package: Path, file: str, old: str, new: str, says: str
) -> None:
    broken = package / "urdf" / file
    broken.write_text(broken.read_text().replace(old, new, 1))
    with pytest.raises(Q2R2Error) as error:
        load_description(MODEL, None, {"my_arm": str(package)})
    assert says in str(error.value)
    assert "arm.urdf.xacro" in str(error.value)
    assert "\n" not in str(error.value)


def test_xacro_arguments_for_a_model_that_is_not_a_xacro_file_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"iiwa7: xacro_args are for models that end in \.xacro"):
        load_description("iiwa7", {"robot_name": "lbr"})


def test_if_xacro_is_not_installed_the_error_says_what_to_install(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(ConfigError, match=re.escape(f"{install_line('xacro')}, or expand it to .urdf")):
        load_description(MODEL, None, {"my_arm": str(package)})
