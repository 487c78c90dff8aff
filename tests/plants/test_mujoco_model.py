from __future__ import annotations

from pathlib import Path

import coal
import mujoco
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config, MujocoConfig, ObjectConfig, ObstacleConfig
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import PlantError
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.plants.mujoco_model import build_model
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


def _pairs_in_contact(plant: MujocoPlant) -> set[frozenset[str]]:
    return {
        frozenset(plant.model.geom(geom).name for geom in (contact.geom1, contact.geom2))
        for contact in plant.data.contact
    }


def test_joint_space_inertia_and_gravity_equal_the_controllers_model(plant: MujocoPlant, robot: Robot) -> None:
    inertia = np.zeros((plant.model.nv, plant.model.nv))
    mujoco.mj_fullM(plant.model, plant.data, inertia)
    index = [plant.model.joint(name).dofadr[0] for name in robot.joint_names]
    data = robot.model.createData()
    expected = pin.crba(robot.model, data, robot.home)
    expected = np.triu(expected) + np.triu(expected, 1).T
    np.testing.assert_allclose(inertia[np.ix_(index, index)], expected, atol=1e-6)
    gravity = pin.computeGeneralizedGravity(robot.model, data, robot.home)
    np.testing.assert_allclose(plant.data.qfrc_bias[index], gravity, atol=1e-5)


def test_the_rotor_inertia_of_each_joint_is_multiplied_by_the_rotor_share_of_the_cell(
    config: Config, robot: Robot
) -> None:
    share = config.mujoco.model_copy(update={"rotor_share": 0.25})
    lighter = MujocoPlant(robot, config.model_copy(update={"mujoco": share}))
    for name, armature in zip(robot.joint_names, robot.model.armature, strict=True):
        assert lighter.model.joint(name).armature[0] == pytest.approx(0.25 * armature)
    lighter.close()


def test_joint_and_torque_limits_equal_the_limits_of_the_robot(plant: MujocoPlant, robot: Robot) -> None:
    for index, name in enumerate(robot.joint_names):
        np.testing.assert_allclose(
            plant.model.joint(name).range, (robot.position_lower[index], robot.position_upper[index])
        )
        np.testing.assert_allclose(
            plant.model.actuator(name).forcerange, (-robot.torque_limit[index], robot.torque_limit[index])
        )


def test_visual_shapes_and_envelopes_have_no_contacts_but_fingers_have_contacts(plant: MujocoPlant) -> None:
    names = {plant.model.geom(index).name for index in range(plant.model.ngeom)}
    assert {"left_link_3_ring", "left_hand_e_finger_1_tip_1_envelope", "right_hand_e_finger_2_contact"} <= names
    for name in names:
        geom = plant.model.geom(name)
        if name.endswith("_envelope") or ("_link_" in name and not name.endswith(("_capsule", "_sphere"))):
            assert (geom.contype[0], geom.conaffinity[0]) == (0, 0), name
    finger = plant.model.geom("left_hand_e_finger_1_contact")
    assert finger.contype[0] == 1
    assert finger.condim[0] >= 4
    assert finger.friction[0] >= 0.8


def test_only_the_blocks_on_the_table_are_in_contact_at_home(plant: MujocoPlant, config: Config) -> None:
    plant.advance(0.5)
    assert _pairs_in_contact(plant) <= {frozenset((name, "table_collision")) for name in config.mujoco.objects}


@pytest.mark.parametrize(
    ("q", "prefixes"),
    [
        pytest.param([0.0, 1.9, 0.0, -0.3, 0.0, 0.5, 0.0] * 2, {"left", "table"}, id="an arm and the table"),
        pytest.param(
            [-1.57, 0.9, 0, -0.5, 0, 0.5, 0, 1.57, 0.9, 0, -0.5, 0, 0.5, 0], {"left", "right"}, id="both arms"
        ),
        pytest.param([0, -1.2, 0, 2.0, 0, -1.5, 0] + [0] * 7, {"left"}, id="an arm and itself"),
    ],
)
def test_bodies_that_can_touch_each_other_have_contacts(plant: MujocoPlant, q: list[float], prefixes: set[str]) -> None:
    plant.reset(np.array(q, dtype=float))
    assert prefixes in [{name.split("_")[0] for name in pair} for pair in _pairs_in_contact(plant)]


SLAB = ObstacleConfig(shape="box", size=(9.0, 9.0, 0.1), position=(0.0, 0.0, -0.25))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("floor", "obstacles", "height"),
    [(0.0, {}, 0.03), (-0.4, {}, -0.37), (None, {}, -4.405), (None, {"floor": SLAB}, -0.17)],
    ids=["at zero", "lower", "none, and the drawing of one touches nothing", "an obstacle of this name"],
)
def test_a_block_falls_onto_the_floor(
    config: Config, floor: float | None, obstacles: dict[str, ObstacleConfig], height: float
) -> None:
    plant = _with_a_falling_block(config.model_copy(update={"obstacles": obstacles}), floor)
    plant.advance(1.0)
    assert plant.data.body("block").xpos[2] == pytest.approx(height, abs=6e-3)
    assert obstacles or plant.model.geom("floor").type[0] == mujoco.mjtGeom.mjGEOM_PLANE


def test_a_finger_can_touch_the_floor(config: Config) -> None:
    plant = _with_a_falling_block(config, 0.2)
    reaching_down = np.array([0.0, 1.6, 0.0, -0.9, 0.0, 0.6, 0.0])
    plant.reset(np.concatenate([reaching_down, reaching_down]))
    assert frozenset(("left_hand_e_finger_1_contact", "floor")) in _pairs_in_contact(plant)


def _with_a_falling_block(config: Config, floor: float | None) -> MujocoPlant:
    """Return the cell without its table, with a block of 6 cm, half a metre above the floor behind the arms."""
    block = ObjectConfig(size=(0.04, 0.04, 0.06), position=(-0.6, 0.0, 0.5))
    obstacles = {name: thing for name, thing in config.obstacles.items() if name != "table"}
    cell = config.model_copy(
        update={"floor": floor, "obstacles": obstacles, "mujoco": MujocoConfig(objects={"block": block})}
    )
    return MujocoPlant(Robot.from_config(cell), cell)


def test_neighbouring_links_have_no_contact_in_the_whole_joint_range(plant: MujocoPlant, robot: Robot) -> None:
    rng = np.random.default_rng(7)
    for _ in range(200):
        plant.reset(rng.uniform(robot.position_lower, robot.position_upper))
        for pair in _pairs_in_contact(plant):
            links = [name.split("_link_") for name in pair if "_link_" in name]
            if len(links) == 2 and links[0][0] == links[1][0]:
                first, second = (int(link[1][0]) for link in links)
                assert abs(first - second) > 1, pair


def test_an_object_with_the_name_of_another_body_is_refused(robot: Robot, config: Config) -> None:
    thing = ObjectConfig(size=(0.04, 0.04, 0.04), position=(0.5, 0.0, 0.3))
    clashing = config.model_copy(update={"mujoco": MujocoConfig(objects={"table": thing})})
    with pytest.raises(PlantError, match=r"dual_iiwa7: MuJoCo cannot make a model of it: .*table"):
        build_model(robot, clashing)


# The mesh is a wedge in a node that turns it by 90 degrees about z. A parser could ignore this rotation.
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="a" count="12">0 0 0 0.1 0 0 0 0.05 0 0 0 0.03</float_array><technique_common>
      <accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
      <param name="Z" type="float"/></accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="s"><node id="n"><matrix>0 -1 0 0 1 0 0 0 0 0 1 0 0 0 0 1</matrix>
    <instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>
"""

# MuJoCo alone would refuse this inertia, because izz is 0.
URDF = """<robot name="rod"><link name="base"/><link name="rod">
<inertial><mass value="1"/><inertia ixx="1e-4" iyy="1e-4" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="wedge.dae" scale="2 2 2"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


def _sorted(points: Array) -> list[tuple[float, ...]]:
    return sorted(map(tuple, np.round(points, 6) + 0.0))


def _cell(folder: Path) -> Config:
    (folder / "rod.urdf").write_text(URDF)
    (folder / "wedge.dae").write_text(DAE)
    (folder / "cell.yaml").write_text("name: rod\narms: {left: {model: rod.urdf, home: [0]}}\n")
    return load_config(folder / "cell.yaml")


def test_the_capsule_of_the_controller_encloses_the_mesh_in_mujoco(tmp_path: Path) -> None:
    config = _cell(tmp_path)
    robot = Robot.from_config(config)
    model = build_model(robot, config)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    geom = next(index for index in range(model.ngeom) if model.geom_type[index] == mujoco.mjtGeom.mjGEOM_MESH)
    vertices = model.mesh_vert @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    expected = [[0, 0, 0], [0, 0.2, 0], [-0.1, 0, 0], [0, 0, 0.06]]
    np.testing.assert_allclose(_sorted(vertices), _sorted(np.array(expected)), atol=1e-6)
    capsule = robot.collision_model.geometryObjects[0]
    assert isinstance(capsule.geometry, coal.Capsule)
    local = (vertices - capsule.placement.translation) @ capsule.placement.rotation
    height = np.clip(local[:, 2], -capsule.geometry.halfLength, capsule.geometry.halfLength)
    across = np.linalg.norm(local - np.outer(height, [0.0, 0.0, 1.0]), axis=1)
    assert (across <= capsule.geometry.radius + 1e-6).all()


def test_an_unreadable_mesh_is_named_in_an_error_of_one_line(tmp_path: Path) -> None:
    config = _cell(tmp_path)
    robot = Robot.from_config(config)
    (tmp_path / "wedge.dae").write_text("no mesh")
    with pytest.raises(PlantError, match=r"wedge\.dae: neither MuJoCo nor Coal can read it") as error:
        build_model(robot, config)
    assert "\n" not in str(error.value)
