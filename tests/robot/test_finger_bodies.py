"""The monitored body of a finger covers everything that the finger sweeps."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

SHAPES = {
    "sphere": '<geometry><sphere radius="0.01"/></geometry>',
    "capsule along": """<origin xyz="0 0.01 0" rpy="1.570796326794897 0 0"/>
        <geometry><cylinder radius="0.01" length="0.02"/></geometry>""",
    "cylinder across": '<origin xyz="0.01 0 0.02"/><geometry><cylinder radius="0.01" length="0.06"/></geometry>',
    "box": '<geometry><box size="0.02 0.01 0.05"/></geometry>',
}
LIMITS = 'velocity="1" effort="10"'


def robot_with(shape: str, kind: str = "prismatic", second: str = "") -> Robot:
    """Return an arm of one joint whose hand has a finger that slides along its y."""
    checking = '<collision_checking><capsule name="shape"/></collision_checking>' if "capsule" in shape else ""
    return Robot.from_urdf(
        f"""<robot name="r"><link name="base"/>
        <link name="arm"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
        <link name="tool"/>
        <link name="finger"><collision name="shape">{SHAPES[shape]}</collision>{checking}</link>
        <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
        <origin xyz="0 0 1"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" {LIMITS}/></joint>
        <joint name="mount" type="fixed"><parent link="arm"/><child link="tool"/>
        <origin xyz="0.2 0 0" rpy="0.3 -0.4 0.5"/></joint>
        <joint name="slide" type="{kind}"><parent link="tool"/><child link="finger"/>
        <origin xyz="0 0.03 0" rpy="0 0 1"/><axis xyz="0 1 0"/><limit lower="-0.01" upper="0.04" {LIMITS}/></joint>
        {second}</robot>""",
        {"left": "tool"},
        unchecked_links=["tool"],  # This permits an arm without a monitored pair.
    )


def bodies(robot: Robot, link: str) -> list[pin.GeometryObject]:
    return [item for item in robot.collision_model.geometryObjects if link_of(item.name) == link]


def beyond(point: Array, item: pin.GeometryObject) -> float:
    """Return how far ``point``, in the frame of the arm's last joint, is outside a capsule [m]."""
    local = item.placement.actInv(point)
    half = getattr(item.geometry, "halfLength", 0.0)
    return float(np.linalg.norm(local - [0.0, 0.0, np.clip(local[2], -half, half)]) - item.geometry.radius)


def finger_at(position: float) -> pin.SE3:
    """Return the pose of the finger's link in the frame of the arm's joint, with the finger at ``position`` [m]."""
    tool = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 0.5), np.array([0.2, 0.0, 0.0]))
    slide = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 1.0), np.array([0.0, 0.03, 0.0]))
    moved: pin.SE3 = tool * slide * pin.SE3(np.eye(3), np.array([0.0, position, 0.0]))
    return moved


@pytest.mark.parametrize("shape", SHAPES)
def test_the_body_of_a_finger_contains_the_finger_at_every_opening(shape: str) -> None:
    (body,) = bodies(robot_with(shape), "finger")
    points = {
        "sphere": 0.01 * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
        "capsule along": np.array([[0.0, 0.0, 0.01], [0.0, 0.02, -0.01], [0.01, 0.01, 0.0]]),
        "cylinder across": np.array([[0.02, 0.0, 0.05], [0.01, 0.01, -0.01], [0.0, 0.0, 0.02]]),
        "box": np.array([[0.01, 0.005, 0.025], [-0.01, 0.005, -0.025], [0.01, -0.005, 0.025]]),
    }[shape]
    for position in np.linspace(-0.01, 0.04, 11):
        for point in points:
            assert beyond(finger_at(position).act(point), body) <= 1e-9, position
    if shape in ("sphere", "capsule along"):
        assert body.geometry.radius == pytest.approx(0.01)
        assert 2 * body.geometry.halfLength == pytest.approx(0.05 if shape == "sphere" else 0.07)


def test_a_turning_finger_gets_a_body_for_all_its_positions_and_a_finger_on_a_planar_joint_keeps_its_shape() -> None:
    (ball,) = bodies(robot_with("sphere", kind="planar"), "finger")
    assert isinstance(ball.geometry, coal.Sphere)
    (body,) = bodies(robot_with("cylinder across", kind="revolute"), "finger")
    for angle in np.linspace(-0.01, 0.04, 11):
        turn = pin.SE3(pin.AngleAxis(angle, np.array([0.0, 1.0, 0.0])).matrix(), np.zeros(3))
        for point in ([0.02, 0.0, 0.05], [0.01, 0.01, -0.01], [0.0, 0.0, 0.02]):
            assert beyond((finger_at(0.0) * turn).act(np.array(point)), body) <= 1e-9, angle


@pytest.mark.parametrize(("away", "count"), [(0.0, 1), (0.001, 2)], ids=["on its line", "beside it"])
def test_two_fingers_have_a_common_body_only_if_they_slide_on_the_same_line(away: float, count: int) -> None:
    second = f"""<link name="other"><collision>{SHAPES["sphere"]}</collision></link>
        <joint name="slide_2" type="prismatic"><parent link="tool"/><child link="other"/><origin xyz="{away} 0.03 0"
        rpy="0 0 1"/><axis xyz="0 -1 0"/><limit lower="0.02" upper="0.06" {LIMITS}/></joint>"""
    robot = robot_with("sphere", second=second)
    found = [*bodies(robot, "finger"), *bodies(robot, "other")]
    assert len(found) == count
    assert found[0].name == "finger_0"
    if count == 1:
        for position in (-0.06, -0.02, 0.0, 0.04):
            assert beyond(finger_at(position).translation, found[0]) == pytest.approx(-0.01, abs=1e-9)


def test_the_column_of_a_lift_that_carries_the_arm_is_not_treated_as_a_finger() -> None:
    lift = f"""<robot name="r"><link name="base"/><link name="tool"/>
        <link name="column"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
        <joint name="lift" type="prismatic"><parent link="base"/><child link="column"/><axis xyz="0 0 1"/>
        <limit lower="0" upper="0.5" {LIMITS}/></joint>
        <joint name="turn" type="revolute"><parent link="column"/><child link="tool"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" {LIMITS}/></joint></robot>"""
    (column,) = bodies(Robot.from_urdf(lift, {"left": "tool"}, unchecked_links=["tool"]), "column")
    assert isinstance(column.geometry, coal.Sphere)
