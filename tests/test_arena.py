"""The functions of benchmarks/arena_*.py are tested on a model of two arms that MuJoCo has compiled."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from arena_hands import TARGET_SPEED, Ask, Judge, ScriptedHands, looking_down
from arena_robot import ArmModel, corners_of, geoms_of, robot_of, tool_pose

LIMIT = 2.0  # Velocity limit of each joint [rad/s].


def an_arm(name: str, x: float) -> str:
    """Return the XML of an arm with two hinges, whose hand has a sliding finger."""
    return f"""
    <body name="{name}_base" pos="{x} 0.1 0.2" euler="0 0 0.3"><geom type="cylinder" size="0.05 0.05"/>
      <body name="{name}_upper" pos="0 0 0.1"><joint name="{name}_1" axis="0 0 1" range="-1 2"/>
        <geom name="{name}_upper" type="box" size="0.03 0.03 0.1" pos="0 0 0.1"/>
        <body name="{name}_hand" pos="0.1 0 0.2" euler="0.5 0 0"><joint name="{name}_2" axis="0 1 0" range="-2 2"/>
          <geom name="{name}_hand" type="box" size="0.02 0.04 0.03"/><site name="{name}_tool" pos="0 0.01 0.1"/>
          <body name="{name}_finger" pos="0 0 0.05">
            <joint name="{name}_slide" type="slide" axis="0 1 0" range="0 0.1"/>
            <geom name="{name}_finger" type="box" size="0.01 0.01 0.02"/>
    </body></body></body></body>"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    arms = an_arm("left", 0.0) + an_arm("right", 1.0)
    text = f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{arms}</worldbody></mujoco>'
    return mujoco.MjModel.from_xml_string(text)


@pytest.fixture(scope="module")
def arms() -> dict[str, ArmModel]:
    limits = np.array([LIMIT, LIMIT])
    return {
        side: ArmModel(f"{side}_base", (f"{side}_1", f"{side}_2"), limits, f"{side}_tool") for side in ("left", "right")
    }


def placed(model: mujoco.MjModel, **positions: float) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for joint, position in positions.items():
        data.joint(joint).qpos[0] = position
    mujoco.mj_forward(model, data)
    return data


def test_a_robot_made_from_a_mujoco_model_has_the_same_tool_poses_and_its_bodies_contain_all_shapes(
    model: mujoco.MjModel, arms: dict[str, ArmModel]
) -> None:
    closing = [placed(model, left_slide=way, right_slide=way).qpos.copy() for way in (0.1, 0.04, 0.0)]
    robot = robot_of(model, arms, closing)
    assert robot.velocity_limit.tolist() == [LIMIT] * 4
    assert robot.position_upper.tolist() == [2.0, 2.0, 2.0, 2.0]
    q = np.array([0.4, -0.7, 1.2, 0.3])
    for way in (0.0, 0.02, 0.07, 0.1):
        data = placed(model, **dict(zip(robot.joint_names, q, strict=True)), left_slide=way, right_slide=way)
        for side, arm in arms.items():
            assert robot.tool_pose(q, side).isApprox(tool_pose(data, arm), 1e-9)
        geometry = robot.collision_model.createData()
        pin.updateGeometryPlacements(robot.model, robot.model.createData(), robot.collision_model, geometry, q)
        for side, arm in arms.items():
            for geom in geoms_of(model, arm):
                corners = corners_of(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
                inside = np.zeros(len(corners), dtype=bool)
                for item, pose in zip(robot.collision_model.geometryObjects, geometry.oMg, strict=True):
                    local = (corners - pose.translation) @ pose.rotation
                    half = item.geometry.halfLength
                    local[:, 2] -= np.clip(local[:, 2], -half, half)
                    within = np.linalg.norm(local, axis=1) <= item.geometry.radius + 1e-9
                    inside |= within & item.name.startswith(side)
                assert inside.all(), (side, geom, way)


def test_the_judge_counts_each_contact_once_and_measures_by_how_much_limits_are_exceeded(
    model: mujoco.MjModel, arms: dict[str, ArmModel]
) -> None:
    judge = Judge(model, arms)
    judge.look(placed(model))
    assert (judge.contacts, judge.breaks_position, judge.breaks_velocity) == (0, False, False)
    data = placed(model, left_1=2.1)
    data.joint("right_2").qvel[0] = -3.0
    judge.look(data)
    assert judge.beyond_position == pytest.approx(0.1)
    assert judge.velocity_ratio == pytest.approx(1.5)
    nearer = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{an_arm('left', 0.0)}{an_arm('right', 0.05)}</worldbody></mujoco>"
    )
    judge = Judge(nearer, arms)
    for _ in range(2):  # The contact lasts, and counts once.
        judge.look(placed(nearer))
    assert judge.contacts == 1
    assert judge.nearest < 0.0


def test_scripted_hands_move_on_a_straight_line_and_wait_for_their_tools_before_they_move_on() -> None:
    asked: list[str] = []

    def asks() -> Iterator[Ask]:
        asked.append("first")
        yield Ask({"left": pin.SE3(np.eye(3), np.array([TARGET_SPEED, 0.0, 0.0]))}, pause=0.2)
        asked.append("second")
        yield Ask({}, closed=("left",))

    start = {"left": pin.SE3.Identity()}
    hands = ScriptedHands(asks(), start)
    for step in range(1, 11):
        hands.advance(start, 0.1)
        assert hands.targets["left"].translation == pytest.approx([TARGET_SPEED * step / 10, 0.0, 0.0])
    for _ in range(4):  # The tool has not arrived.
        hands.advance(start, 0.1)
    assert asked == ["first"]
    while len(asked) == 1:
        hands.advance(hands.targets, 0.1)
    assert hands.closed == ("left",)
    hands.advance(hands.targets, 0.1)
    assert hands.done


def test_the_function_looking_down_returns_a_rotation_whose_x_axis_has_the_given_direction() -> None:
    rotation = looking_down(np.array([0.0, 2.0]))
    assert rotation[:, 0] == pytest.approx([0.0, 1.0, 0.0])
    assert rotation[:, 2] == pytest.approx([0.0, 0.0, -1.0])
    assert looking_down(np.array([1.0, 0.0]), -0.5)[:, 2] == pytest.approx([0.0, -np.sin(0.5), -np.cos(0.5)])
