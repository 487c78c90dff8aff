"""Collision meshes that MuJoCo has no decoder for reach it as data."""

from __future__ import annotations

from pathlib import Path

import coal
import mujoco
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from q2r2_control.cli.app import app
from q2r2_control.config.cell import Config, load_config
from q2r2_control.errors import PlantError
from q2r2_control.plants.mujoco_model import build_model
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

KINOVA = {
    "name": "kinova",
    "arms": {"left": {"model": "example-robot-data:kinova", "home": [0, 2.9, 1.3, 0, 1.57, 0]}},
}

# A wedge in a node that turns it about z by a quarter, which a reader could overlook.
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

URDF = """<robot name="rod"><link name="base"/><link name="rod">
<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh filename="wedge.dae" scale="2 2 2"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.mark.slow
def test_a_cell_with_dae_meshes_that_passes_the_check_runs_in_mujoco(tmp_path: Path) -> None:
    file = tmp_path / "kinova.yaml"
    file.write_text(yaml.safe_dump(KINOVA))
    assert CliRunner().invoke(app, ["check", str(file)]).exit_code == 0
    ran = CliRunner().invoke(app, ["run", str(file), "--fast", "--duration", "0.2", "--headless", "--json"])
    assert ran.exit_code == 0, ran.output


def _sorted(points: Array) -> list[tuple[float, ...]]:
    return sorted(map(tuple, np.round(points, 6) + 0.0))


def _cell(folder: Path) -> Config:
    (folder / "rod.urdf").write_text(URDF)
    (folder / "wedge.dae").write_text(DAE)
    (folder / "cell.yaml").write_text("name: rod\narms: {left: {model: rod.urdf, home: [0]}}\n")
    return load_config(folder / "cell.yaml")


def test_mujocos_mesh_is_the_one_that_the_controller_encloses(tmp_path: Path) -> None:
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


def test_a_mesh_that_nobody_can_read_is_named_in_one_line(tmp_path: Path) -> None:
    config = _cell(tmp_path)
    robot = Robot.from_config(config)
    (tmp_path / "wedge.dae").write_text("no mesh")
    with pytest.raises(PlantError, match=r"wedge\.dae: neither MuJoCo nor Coal can read it") as error:
        build_model(robot, config)
    assert "\n" not in str(error.value)
