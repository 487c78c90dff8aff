"""Forms of a URDF that programs interpret differently are unified, refused, or reported."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import RobotError
from q2r2_control.robot.description import load_description, parse_urdf
from q2r2_control.robot.pinocchio_models import joint_origin, read_models
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.urdf_forms import notes_on
from q2r2_control.robot.urdf_parts import shape_from_drawings

ARM = """<robot name="arm"><link name="base"/><link name="hand">{link}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="hand"/><origin xyz="0 0 1" {origin}/>
<limit lower="{lower}" upper="{upper}" velocity="{speed}" effort="9"/>{safety}</joint></robot>"""
USUAL = {"link": "", "origin": "", "lower": "-1", "upper": "1", "speed": "2", "safety": ""}
TRIANGLE = (
    b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid"
)
COLLADA = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="millimeter" meter="0.001"/></asset></COLLADA>"""


def arm(**parts: str) -> ET.Element:
    return parse_urdf(ARM.format(**(USUAL | parts)), "arm.urdf")


def test_an_origin_given_by_a_quaternion_equals_the_same_origin_given_by_roll_pitch_and_yaw() -> None:
    turned = pin.Quaternion(pin.rpy.rpyToMatrix(0.3, -0.7, 2.0)).coeffs()
    joint = arm(origin=f'quat_xyzw="{" ".join(map(str, turned))}"').find("joint")
    assert joint is not None
    np.testing.assert_allclose(joint_origin(joint).rotation, pin.rpy.rpyToMatrix(0.3, -0.7, 2.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "origin", ['quat_xyzw="0 0 0 2"', 'quat_xyzw="0 0 1"', 'quat_xyzw="a b c d"', 'quat_xyzw="0 0 0 1" rpy="0 0 0"']
)
def test_an_invalid_or_contradictory_quaternion_is_refused(origin: str) -> None:
    with pytest.raises(RobotError, match="quat_xyzw"):
        arm(origin=origin)


def test_the_error_about_xacro_elements_names_these_elements_because_urdf_readers_would_skip_them() -> None:
    text = ARM.format(**USUAL).replace("</robot>", "<xacro:hand xmlns:xacro='http://ros.org/wiki/xacro'/></robot>")
    with pytest.raises(RobotError, match=r"xacro:hand.*allowed.*\.xacro"):
        parse_urdf(text, "arm.urdf")


INERTIA = "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/>"


@pytest.mark.parametrize(("has", "lacks"), [("<mass value='1'/>", "inertia"), (INERTIA, "mass")])
def test_an_inertial_with_only_a_mass_or_only_an_inertia_is_refused_with_the_name_of_its_link(
    has: str, lacks: str
) -> None:
    with pytest.raises(RobotError, match=f"the <inertial> of link hand has no <{lacks}>; allowed: both"):
        arm(link=f"<inertial>{has}</inertial>")


def test_an_empty_inertial_counts_as_no_inertial() -> None:
    assert arm(link="<inertial><origin/></inertial>").find("link[@name='hand']/inertial") is None


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"safety": "<safety_controller soft_lower_limit='-0.5' soft_upper_limit='0.5'/>"}, "soft limits"),
        ({"lower": "-170", "upper": "170"}, "degrees"),
        ({"speed": "180"}, "degrees"),
    ],
)
def test_a_note_on_suspicious_limits_names_their_joint(parts: dict[str, str], said: str) -> None:
    (note,) = notes_on(ET.fromstring(ARM.format(**(USUAL | parts))))
    assert note.text.startswith("turn ")
    assert said in note.text


@pytest.mark.parametrize("safety", ["", "<safety_controller k_velocity='1'/>"])
def test_there_are_no_notes_on_usual_limits(safety: str) -> None:
    assert notes_on(ET.fromstring(ARM.format(**(USUAL | {"safety": safety})))) == []


def test_a_file_is_read_in_the_encoding_that_its_first_line_names(tmp_path: Path) -> None:
    text = '<?xml version="1.0" encoding="ISO-8859-1"?><!-- Gr\u00fc\u00dfe -->' + ARM.format(**USUAL)
    (tmp_path / "arm.urdf").write_bytes(text.encode("latin-1"))
    assert load_description(str(tmp_path / "arm.urdf")).name == "arm"
    assert Robot.from_urdf(tmp_path / "arm.urdf", {"left": "hand"}, unchecked_links=["hand"]).name == "arm"


def with_mesh(folder: Path, name: str, content: bytes) -> ET.Element:
    (folder / name).write_bytes(content)
    shape = f'<collision><geometry><mesh filename="{name}" scale="2 1 1"/></geometry></collision>'
    (folder / "arm.urdf").write_text(ARM.format(**(USUAL | {"link": shape})), encoding="utf-8")
    return load_description(str(folder / "arm.urdf")).urdf


def test_collision_meshes_in_millimetres_are_scaled_to_metres(tmp_path: Path) -> None:
    mesh = next(with_mesh(tmp_path, "hand.dae", COLLADA.encode()).iter("mesh"))
    assert [float(part) for part in mesh.get("scale", "").split()] == pytest.approx([2e-3, 1e-3, 1e-3])


def test_a_visual_mesh_in_millimetres_that_becomes_a_collision_shape_is_scaled_to_metres(tmp_path: Path) -> None:
    (tmp_path / "hand.dae").write_text(COLLADA)
    drawn = f'<link name="hand"><visual><geometry><mesh filename="{tmp_path}/hand.dae"/></geometry></visual></link>'
    link = ET.fromstring(drawn)
    shape_from_drawings([link], ["hand"])
    scales = [mesh.get("scale") for mesh in link.iter("mesh")]
    assert scales[0] is None, "the drawing stays as it is"
    assert [float(part) for part in (scales[1] or "").split()] == pytest.approx([1e-3] * 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"), (b"\0" * 84, "hand.stl")],
    ids=["pointer of Git LFS", "no triangles"],
)
def test_the_error_about_a_mesh_that_cannot_be_read_names_the_file_or_what_to_do(
    tmp_path: Path, content: bytes, said: str
) -> None:
    with pytest.raises(RobotError, match=said):
        read_models(with_mesh(tmp_path, "hand.stl", content), "arm.urdf")


def test_a_mesh_of_one_triangle_is_accepted_as_a_shape(tmp_path: Path) -> None:
    _, geometry = read_models(with_mesh(tmp_path, "hand.stl", TRIANGLE), "arm.urdf")
    assert isinstance(geometry.geometryObjects[0].geometry, coal.BVHModelBase)
