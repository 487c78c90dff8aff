from __future__ import annotations

import re
import tracemalloc
import xml.etree.ElementTree as ET
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
import yaml

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import parse_config
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.description import load_description
from q2r2_control.robot.enclose import enclose_shapes, enclosing_capsule
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


def _reach(points: Array, start: Array, end: Array) -> Array:
    """Return the distance of each point from the segment."""
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-300), 0, 1)
    return np.asarray(np.linalg.norm(points - start - np.outer(share, along), axis=1))


def _clouds() -> dict[str, Array]:
    random = np.random.default_rng(7)
    ball = random.normal(size=(400, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    return {
        "a rod": ball * [0.01, 0.01, 0.5],
        "a ball": 0.1 * ball,
        "a disc": ball * [0.3, 0.3, 0.01],
        "a brick": np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.2) for z in (0, 0.4)]),
        "an L": np.vstack([random.random((200, 3)) * [0.5, 0.05, 0.05], random.random((200, 3)) * [0.05, 0.05, 0.5]]),
        "a flat plate": random.random((50, 3)) * [1, 1, 0],
        "points on a line": np.outer(np.linspace(0, 1, 9), [1, 2, 3]),
        "two points": np.array([[0.0, 0, 0], [0, 0, 1]]),
        "one point": np.array([[1.0, 2, 3]]),
        "equal points": np.ones((5, 3)),
        "millimetres": 1e3 * ball * [1, 2, 3],
        "far from the origin": ball * [0.1, 0.1, 0.3] + [1e3, -1e3, 1e3],
    }


@pytest.mark.parametrize("cloud", _clouds().values(), ids=_clouds())
def test_every_vertex_of_a_mesh_is_inside_the_capsule_around_the_mesh(cloud: Array) -> None:
    points = cloud @ pin.rpy.rpyToMatrix(0.3, -1.1, 2.0).T
    radius, start, end = enclosing_capsule(points)
    assert np.isfinite([radius, *start, *end]).all()
    assert _reach(points, start, end).max() <= radius


def _geometry(model: str) -> pin.GeometryModel:
    text = ET.tostring(load_description(model).urdf, encoding="unicode")
    return pin.buildGeomFromUrdfString(pin.buildModelFromXML(text), text, pin.GeometryType.COLLISION)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["panda", "ur5", "xarm7"])
def test_the_capsules_of_a_real_arm_contain_every_vertex_of_its_meshes(model: str) -> None:
    meshes, enclosed = _geometry(f"example-robot-data:{model}"), _geometry(f"example-robot-data:{model}")
    enclose_shapes(enclosed)
    checked = 0
    for before, after in zip(meshes.geometryObjects, enclosed.geometryObjects, strict=True):
        assert before.name == after.name
        if not isinstance(before.geometry, coal.BVHModelBase):
            continue
        points = np.array([before.placement.act(vertex) for vertex in before.geometry.vertices()])
        half = np.array([0.0, 0.0, after.geometry.halfLength])
        ends = after.placement.act(-half), after.placement.act(half)
        assert _reach(points, *ends).max() <= after.geometry.radius
        checked += 1
    assert checked >= 6


def _one(shape: coal.CollisionGeometry, parent_joint: int) -> pin.GeometryModel:
    geometry = pin.GeometryModel()
    geometry.addGeometryObject(pin.GeometryObject("thing_0", parent_joint, pin.SE3.Random(), shape))
    return geometry


@pytest.mark.parametrize("parent_joint", [0, 1], ids=["fixed in the world", "on a moving link"])
@pytest.mark.parametrize(
    "shape",
    [
        coal.Cylinder(0.1, 1.0), coal.Cylinder(0.5, 0.02), coal.Cylinder(0.1, 0.2), coal.Box(0.1, 0.2, 0.3),
    ],
    ids=["post", "round table top", "tin", "box"],
)  # fmt: skip
def test_a_primitive_shape_lies_inside_the_capsule_or_box_that_replaces_it(
    shape: coal.CollisionGeometry, parent_joint: int
) -> None:
    geometry = _one(shape, parent_joint)
    before = geometry.geometryObjects[0].copy()
    enclose_shapes(geometry)
    after = geometry.geometryObjects[0]
    assert isinstance(after.geometry, coal.Capsule | coal.Box)
    assert parent_joint == 0 or not isinstance(after.geometry, coal.Box)
    points = np.array([after.placement.actInv(before.placement.act(point)) for point in _surface(shape)])
    if isinstance(after.geometry, coal.Box):
        assert (np.abs(points) <= after.geometry.halfSide + 1e-12).all()
    else:
        half = np.array([0.0, 0.0, after.geometry.halfLength])
        assert _reach(points, -half, half).max() <= after.geometry.radius


def _surface(shape: coal.CollisionGeometry) -> Array:
    random = np.random.default_rng(3)
    ball = random.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    if isinstance(shape, coal.Box):
        return np.asarray(np.sign(ball) * shape.halfSide)
    angle = random.uniform(0, 2 * np.pi, 2000)
    side = np.where(random.random(2000) < 0.5, -1.0, 1.0)
    return np.column_stack([shape.radius * np.cos(angle), shape.radius * np.sin(angle), side * shape.halfLength])


def test_capsules_spheres_and_fixed_boxes_are_not_changed() -> None:
    for shape in (coal.Capsule(0.1, 0.4), coal.Sphere(0.1), coal.Box(1.0, 1.0, 1.0)):
        geometry = _one(shape, 0)
        enclose_shapes(geometry)
        assert geometry.geometryObjects[0].geometry == shape


def test_the_error_about_an_unbounded_shape_names_the_shape_and_its_kind() -> None:
    with pytest.raises(RobotError, match="thing_0 is a Halfspace"):
        enclose_shapes(_one(coal.Halfspace(np.array([0.0, 0, 1]), 0.0), 0))


def test_a_mesh_without_triangles_is_refused(tmp_path: Path) -> None:
    (tmp_path / "tip.stl").write_text("solid nothing\nendsolid nothing\n")
    (tmp_path / "arm.urdf").write_text(
        '<robot name="a"><link name="base"/><link name="tip"><collision><geometry><mesh filename="tip.stl"/>'
        '</geometry></collision></link><joint name="j" type="revolute"><parent link="base"/><child link="tip"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    arms = {"left": {"model": str(tmp_path / "arm.urdf"), "home": [0.0]}}
    with pytest.raises(RobotError):
        Robot.from_config(Config.model_validate({"name": "a", "arms": arms}))


def _slender_brick() -> coal.BVHModelOBBRSS:
    """Return a brick 1 m long, with vertices at both ends only."""
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(12, 8)
    corners = _clouds()["a brick"] * [1.0, 0.5, 2.5]
    for quad in ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)):
        for triangle in (quad[:3], (quad[0], *quad[2:])):
            mesh.addTriangle(*corners[list(triangle)])
    mesh.endModel()
    return mesh


def _on_triangles(mesh: coal.BVHModelBase) -> Array:
    random = np.random.default_rng(5)
    numbers = random.integers(mesh.num_tris, size=20_000)
    corners = np.array([[mesh.tri_indices(int(i))[k] for k in range(3)] for i in numbers])
    weights = random.dirichlet([0.5, 0.5, 0.5], len(numbers))
    return np.asarray(np.einsum("nk,nkd->nd", weights, mesh.vertices()[corners]))


def _volume(capsules: list[pin.GeometryObject]) -> float:
    shapes = [item.geometry for item in capsules]
    return float(sum(np.pi * one.radius**2 * (2 * one.halfLength + 4 / 3 * one.radius) for one in shapes))


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("link", ["forearm_link", "upper_arm_link", "thing"])
def test_the_capsules_of_a_link_together_contain_its_mesh(link: str, count: int) -> None:
    before = _one(_slender_brick(), 1) if link == "thing" else _geometry("example-robot-data:ur5")
    enclosed = before.copy()
    mesh = next(item for item in before.geometryObjects if item.name == f"{link}_0")
    enclose_shapes(enclosed, {link: count})
    capsules = [item for item in enclosed.geometryObjects if link_of(item.name) == link]
    assert [item.name for item in capsules] == [f"{link}_{number}" for number in range(count)]
    points = np.array([mesh.placement.act(point) for point in _on_triangles(mesh.geometry)])
    beyond = np.full(len(points), np.inf)
    for item in capsules:
        assert (item.parentJoint, item.parentFrame) == (mesh.parentJoint, mesh.parentFrame)
        half = np.array([0.0, 0.0, item.geometry.halfLength])
        ends = item.placement.act(-half), item.placement.act(half)
        beyond = np.minimum(beyond, _reach(points, *ends) - item.geometry.radius)
    assert beyond.max() <= 0.0


def test_three_capsules_around_a_forearm_have_a_clearly_smaller_volume_than_one_capsule() -> None:
    volumes = []
    for counts in ({}, {"forearm_link": 3}):
        geometry = _geometry("example-robot-data:ur5")
        enclose_shapes(geometry, counts)
        volumes.append(_volume([item for item in geometry.geometryObjects if link_of(item.name) == "forearm_link"]))
    assert volumes[1] < 0.75 * volumes[0]


_FOREARM = [f"left_forearm_link_{number}" for number in range(3)]


def _ur5(**keys: object) -> Config:
    arms = {"left": {"model": "example-robot-data:ur5", "tip": "tool0", "home": [0.0, -1.0, 1.3, 0.4, 1.2, 0.0]}}
    return Config.model_validate({"name": "a", "arms": arms, **keys})


def test_a_cell_monitors_each_capsule_of_a_link() -> None:
    plain, fine = (Robot.from_config(_ur5(capsules=counts)) for counts in ({}, {"left_forearm_link": 3}))
    names = [item.name for item in fine.collision_model.geometryObjects]
    assert names == [*(item.name for item in plain.collision_model.geometryObjects), *_FOREARM[1:]]
    pairs = set(pair_names(fine.collision_model))
    assert pairs > set(pair_names(plain.collision_model))
    assert {("floor_0", name) in pairs or (name, "floor_0") in pairs for name in _FOREARM} == {True}


@pytest.mark.parametrize(
    ("capsules", "says"),
    [
        (
            {"forearm_link": 2},
            "capsules.forearm_link: no link with a shape; allowed: floor, left_base_link, left_ee_link, left_fo",
        ),
        ({"left_ee_link": 2}, "capsules.left_ee_link = 2: this link has no mesh; allowed: 1"),
        ({"left_forearm_link": 5}, "capsules.left_forearm_link = 5"),
        ({"left_forearm_link": 0}, "capsules.left_forearm_link = 0"),
        ({"left_elbow": 1}, "capsules.left_elbow: no link with a shape; allowed: floor, left_base_link, left_ee_link"),
    ],
    ids=["no link of the cell", "a box", "too many", "none", "one, of no link of the cell"],
)
def test_impossible_numbers_of_capsules_are_refused(capsules: dict[str, int], says: str) -> None:
    text = yaml.safe_dump(_ur5().model_dump(mode="json", exclude_unset=True) | {"capsules": capsules})
    with pytest.raises(ConfigError, match=re.escape(says)):
        Robot.from_config(parse_config(text, "cell.yaml"))


def test_the_capsule_of_a_round_mesh_is_found_without_an_array_of_all_pairs_of_points() -> None:
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)  # All points are corners of their convex hull.
    tracemalloc.start()
    try:
        radius, _, _ = enclosing_capsule(points)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert radius >= 0.999
    assert peak < 20e6, "3000 x 3000 numbers are 72 MB"
