"""The URDF of an MJCF file has the motion, the masses and the shapes of MuJoCo."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import coal
import mujoco
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import RobotError
from q2r2_control.robot.description import LinkTree, parse_urdf
from q2r2_control.robot.mjcf import urdf_of_mjcf

ARM = """<mujoco>
<compiler meshdir="parts"/>
<asset><mesh name="wedge" file="wedge.obj" scale="0.5 1 2"/></asset>
<worldbody>
<geom type="plane" size="2 2 0.1"/>
<body name="cup" pos="1 0 0.1"><freejoint/><geom type="box" size="0.03 0.03 0.05"/></body>
<body name="base" pos="0.3 0 0.7" euler="0 0 90">
  <geom type="cylinder" size="0.1 0.05"/>
  <body name="shoulder" pos="0 0 0.1" euler="20 0 -30">
    <joint name="turn" axis="0 0 1" pos="0.02 0 0" range="-150 150" ref="15" armature="0.2" damping="0.4"/>
    <joint name="lift" axis="0 1 0" pos="0 0.03 0.1" range="-90 90" ref="-10" actuatorfrcrange="-80 60"/>
    <geom type="capsule" fromto="0 0 0 0.1 0 0.4" size="0.06"/>
    <geom type="mesh" mesh="wedge" contype="0" conaffinity="0" pos="0.1 0 0.2" euler="0 30 0" rgba="1 0 0 1"/>
    <body name="slide" pos="0.1 0 0.4">
      <joint name="out" type="slide" axis="1 0 1" range="0 0.3" ref="0.1"/>
      <geom type="ellipsoid" size="0.03 0.05 0.07" pos="0 0 0.05"/>
      <body name="spinner" pos="0 0.05 0.1" euler="0 40 0">
        <joint name="spin" axis="1 0 0"/>
        <geom type="mesh" mesh="wedge" contype="0" conaffinity="0"/>
        <body name="finger_a"><joint name="a" type="slide" axis="0 1 0" range="0 0.04"/><geom size="0.01"/></body>
        <body name="finger_b"><joint name="b" type="slide" axis="0 1 0" range="-0.04 0"/><geom size="0.01"/></body>
      </body>
    </body>
  </body>
</body></worldbody>
<equality><joint joint1="b" joint2="a" polycoef="0 -1 0 0 0"/></equality>
<actuator><motor joint="turn" gear="50" ctrlrange="-2 2"/><position joint="spin" kp="100" forcerange="-9 12"/>
<motor joint="lift" gear="-100" ctrlrange="-1 1" forcerange="-150 150"/></actuator>
</mujoco>"""
ONE_LINK = '<robot name="r"><link name="l"/></robot>'
JOINTS = ("turn", "lift", "out", "spin", "a", "b")


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """Return the MJCF file. The origin of its mesh is not the centre of the mesh."""
    (tmp_path / "parts").mkdir()
    corners = "v 0.1 0 0\nv 0.3 0 0\nv 0.1 0.1 0\nv 0.1 0 0.05\n"
    (tmp_path / "parts" / "wedge.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    file = tmp_path / "arm.xml"
    file.write_text(ARM)
    return file


def read(file: Path) -> tuple[ET.Element, pin.Model, pin.GeometryModel]:
    text = ET.tostring(urdf_of_mjcf(file, file.parent, 2.0), encoding="unicode")
    urdf = parse_urdf(text, "arm.urdf", file.parent)
    text = ET.tostring(urdf, encoding="unicode")
    model = pin.buildModelFromXML(text)
    return urdf, model, pin.buildGeomFromUrdfString(model, text, pin.GeometryType.COLLISION)


def test_links_shapes_and_gravity_torques_equal_the_results_of_mujoco_in_random_postures(arm: Path) -> None:
    urdf, model, geometry = read(arm)
    theirs = mujoco.MjModel.from_xml_path(str(arm))
    assert LinkTree(urdf, "arm").root == "base", "what moves freely and the floor are no part of it"
    base = theirs.body("base")
    data, state, shapes = model.createData(), mujoco.MjData(theirs), geometry.createData()
    root = pin.XYZQUATToSE3(np.r_[base.pos, base.quat[[1, 2, 3, 0]]])
    model.gravity.linear = root.rotation.T @ theirs.opt.gravity
    random = np.random.default_rng(0)
    for _ in range(20):
        values = random.uniform(-1.0, 1.0, len(JOINTS))
        q = np.zeros(model.nq)
        for name, value in zip(JOINTS, values, strict=True):
            state.joint(name).qpos = q[model.joints[model.getJointId(name)].idx_q] = value
        mujoco.mj_forward(theirs, state)
        pin.updateGeometryPlacements(model, data, geometry, shapes, q)
        forces = pin.computeGeneralizedGravity(model, data, q)
        for name in JOINTS:
            mine = forces[model.joints[model.getJointId(name)].idx_v]
            assert mine == pytest.approx(float(state.joint(name).qfrc_bias[0]), abs=1e-9), name
        for item, placement in zip(geometry.geometryObjects, shapes.oMg, strict=True):
            link = item.name.rpartition("_")[0]
            centre = (root * placement).act(_centre(item.geometry))
            geoms = range(theirs.body(link).geomadr[0], theirs.body(link).geomadr[0] + theirs.body(link).geomnum[0])
            theirs_at = [_geom_centre(theirs, state, g) for g in geoms]
            assert min(np.linalg.norm(centre - at) for at in theirs_at) < 1e-6, item.name


def _centre(shape: coal.CollisionGeometry) -> np.ndarray:
    return np.array(shape.vertices()).mean(axis=0) if isinstance(shape, coal.BVHModelBase) else np.zeros(3)


def _geom_centre(model: mujoco.MjModel, data: mujoco.MjData, g: int) -> np.ndarray:
    if (mesh := model.geom_dataid[g]) < 0:
        return data.geom_xpos[g]
    first = model.mesh_vertadr[mesh]
    corners = np.unique(model.mesh_vert[first : first + model.mesh_vertnum[mesh]].round(9), axis=0)
    return data.geom_xpos[g] + data.geom_xmat[g].reshape(3, 3) @ corners.mean(axis=0)


def test_the_limits_of_joints_come_from_the_file_but_their_velocity_limits_come_from_the_caller(arm: Path) -> None:
    urdf, _, _ = read(arm)

    def written(joint: str, element: str) -> dict[str, str]:
        return urdf.findall(f"joint[@name='{joint}']/{element}")[0].attrib

    efforts = [float(written(name, "limit")["effort"]) for name in JOINTS]
    speeds = [float(written(name, "limit")["velocity"]) for name in JOINTS]
    assert (efforts, speeds) == ([100, 60, 0, 9, 0, 0], [2, 2, 0, 2, 0, 0])
    assert float(written("turn", "limit")["upper"]) == pytest.approx(np.deg2rad(150))
    assert float(written("out", "limit")["upper"]) == 0.3
    assert written("b", "mimic") == {"joint": "a", "multiplier": "-1.0", "offset": "0.0"}
    assert written("turn", "rotor") == {"inertia": "0.2", "gear": "1"}


def test_a_capsule_stays_a_capsule_and_a_visual_geom_becomes_a_collision_shape_only_if_its_body_has_none(
    arm: Path,
) -> None:
    urdf, _, geometry = read(arm)
    shapes = {item.name.rpartition("_")[0]: item.geometry for item in geometry.geometryObjects}
    assert isinstance(shapes["shoulder"], coal.Capsule)
    assert float(urdf.findall("link[@name='shoulder_before_turn']/inertial/mass")[0].get("value", "")) > 0.0
    assert isinstance(shapes["spinner"], coal.BVHModelBase)
    assert len(urdf.findall("link[@name='shoulder']/visual/geometry/mesh")) == 1
    contact = '<contact><pair geom1="table" geom2="drawn"/></contact></mujoco>'
    text = ARM.replace('<geom type="plane"', '<geom name="table" type="plane"').replace("</mujoco>", contact)
    arm.write_text(text.replace('type="mesh" mesh="wedge" contype', 'name="drawn" type="mesh" mesh="wedge" contype', 1))
    assert read(arm)[0].findall("link[@name='shoulder']/visual") == [], "a pair names it"
    assert 2.0 * shapes["slide"].halfSide == pytest.approx([0.06, 0.1, 0.14])  # This is the box around the ellipsoid.


def test_a_file_with_two_arms_gets_a_root_link_at_the_origin_of_the_world(arm: Path) -> None:
    text = re.sub(r'<body name="base"', '<body name="other" pos="0 1 0"><joint/><geom size="0.1"/></body>\\g<0>', ARM)
    arm.write_text(text)
    urdf, model, _ = read(arm)
    assert LinkTree(urdf, "arm").root == "mjcf_world"
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    for name in ("base", "other"):
        theirs = mujoco.MjModel.from_xml_path(str(arm)).body(name).pos
        assert data.oMf[model.getFrameId(name)].translation == pytest.approx(theirs)


def test_names_that_the_urdf_adds_differ_from_all_names_of_the_file(arm: Path) -> None:
    text = ARM.replace('name="slide"', 'name="shoulder_before_turn"').replace('name="spinner"', 'name="mjcf_world"')
    arm.write_text(text.replace('name="base"', 'name="base"><joint name="j"/><geom size="1"/></body><body name="b"'))
    assert LinkTree(read(arm)[0], "arm").root == "mjcf_world_"


@pytest.mark.parametrize(
    ("change", "to", "says"),
    [
        ("<worldbody>", "<worldbod>", "arm.xml: MuJoCo cannot read it"),
        ('name="spin" axis="1 0 0"', 'name="spin" type="ball"', "arm.xml: joint spin is a ball joint"),
        ('type="cylinder" size="0.1 0.05"', 'type="plane" size="1 1 1"', "body base has a shape of kind mjGEOM_PLANE"),
        ("scale=", 'refpos="0 0 1" scale=', "arm.xml: mesh wedge has refpos or refquat"),
        (".*", ONE_LINK, "arm.xml: the root element is <robot>; an MJCF starts with <mujoco>"),
        ('file="wedge.obj" scale="0.5 1 2"', 'vertex="0 0 0 1 0 0 0 1 0 0 0 1"', "mesh wedge: .*allowed: a file that"),
        ('<body name="base".*?</worldbody>.*</actuator>', "</worldbody>", "arm.xml: no joint that turns or slides"),
    ],
)
def test_an_mjcf_that_cannot_be_converted_to_urdf_raises_an_error_of_one_line(
    arm: Path, change: str, to: str, says: str
) -> None:
    text = re.sub(change, to, ARM, count=1, flags=re.DOTALL)
    assert text != ARM
    arm.write_text(text)
    with pytest.raises(RobotError, match=says) as raised:
        read(arm)
    assert "\n" not in str(raised.value)
