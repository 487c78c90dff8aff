from __future__ import annotations

import re
from copy import copy

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import RobotError
from q2r2_control.robot.compose import ComposedCell
from q2r2_control.robot.description import load_description
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot

TOOLS = {"left": "left_tool_frame", "right": "right_tool_frame"}


def _urdf(links: int = 3, limit: str = 'lower="-1" upper="1" velocity="1" effort="1"', kind: str = "revolute") -> str:
    """Return a chain of links 0.3 m apart, each with a sphere whose radius is 0.1 m."""
    ball = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    return '<robot name="chain"><link name="l0"/>' + "".join(
        f'<link name="l{n}">{ball}</link><joint name="j{n}" type="{kind}"><parent link="l{n - 1}"/>'
        f'<child link="l{n}"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit {limit}/></joint>'
        for n in range(1, links + 1)
    ) + "</robot>"  # fmt: skip


def test_the_arrays_of_a_robot_have_the_order_of_its_joint_names(dual_iiwa7: Robot) -> None:
    robot = dual_iiwa7
    assert robot.joint_names == tuple(f"{side}_A{number}" for side in ("left", "right") for number in range(1, 8))
    assert robot.model.nq == robot.model.nv == 14
    for values in (robot.home, robot.position_lower, robot.position_upper, robot.velocity_limit, robot.torque_limit):
        assert values.shape == (14,)
    assert robot.arms["left"].joints.tolist() == list(range(7))
    assert robot.arms["right"].joints.tolist() == list(range(7, 14))
    assert (robot.position_lower < robot.home).all()
    assert (robot.home < robot.position_upper).all()


def test_the_joints_of_fingers_are_locked_at_their_open_positions(dual_iiwa7: Robot) -> None:
    assert not [name for name in dual_iiwa7.joint_names if "finger" in name]
    finger = dual_iiwa7.model.frames[dual_iiwa7.model.getFrameId("left_hand_e_finger_1", pin.FrameType.BODY)]
    tool = dual_iiwa7.model.frames[dual_iiwa7.arms["left"].frame_id]
    assert (tool.placement.inverse() * finger.placement).translation[1] == pytest.approx(0.025)


@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
def test_at_home_the_tools_point_down_at_mirrored_positions_and_no_monitored_pair_is_close(
    dual_iiwa: Robot, side: str, sign: int
) -> None:
    pose = dual_iiwa.tool_pose(dual_iiwa.home, side)
    np.testing.assert_allclose(pose.translation, [0.5, 0.25 * sign, 0.38], atol=2e-4)
    np.testing.assert_allclose(pose.rotation, np.diag([-1.0, 1.0, -1.0]), atol=2e-4)
    assert min(pair.distance for pair in dual_iiwa.distances(dual_iiwa.home)) > 0.04


def test_the_method_distances_has_the_order_of_the_models_pairs_and_negative_values_in_penetration(
    dual_iiwa7: Robot,
) -> None:
    pairs = dual_iiwa7.distances(dual_iiwa7.home)
    assert tuple((pair.name_a, pair.name_b) for pair in pairs) == pair_names(dual_iiwa7.collision_model)
    into_the_table = np.where(np.arange(14) % 7 == 1, 2.0, 0.0)
    worst = min(dual_iiwa7.distances(into_the_table), key=lambda pair: pair.distance)
    assert worst.distance < -0.01
    assert "table_0" in (worst.name_a, worst.name_b)


def test_a_robot_that_is_loaded_from_the_urdf_of_another_robot_is_equal_to_that_robot(
    dual_iiwa7: Robot, dual_iiwa7_cell: ComposedCell
) -> None:
    again = Robot.from_urdf(dual_iiwa7.urdf, TOOLS, srdf=dual_iiwa7_cell.srdf)
    assert again.name == "dual_iiwa7"
    assert again.joint_names == dual_iiwa7.joint_names
    assert pair_names(again.collision_model) == pair_names(dual_iiwa7.collision_model)
    np.testing.assert_array_equal(again.model.armature, dual_iiwa7.model.armature)
    np.testing.assert_allclose(
        again.tool_pose(dual_iiwa7.home, "left").homogeneous,
        dual_iiwa7.tool_pose(dual_iiwa7.home, "left").homogeneous,
    )


def test_calling_robot_with_a_file_name_raises_an_error_that_names_the_right_constructors(dual_iiwa7: Robot) -> None:
    with pytest.raises(RobotError, match=re.escape("Robot('arm.urdf', ...): allowed: Robot.from_config(config), Rob")):
        Robot("arm.urdf")  # type: ignore[call-arg, arg-type]
    assert copy(dual_iiwa7).joint_names == dual_iiwa7.joint_names


def test_a_robot_can_have_only_one_of_the_two_arms_in_its_urdf(dual_iiwa7_cell: ComposedCell) -> None:
    robot = Robot.from_urdf(dual_iiwa7_cell.urdf, {"left": "left_tool_frame"}, srdf=dual_iiwa7_cell.srdf)
    assert robot.joint_names == tuple(f"left_A{number}" for number in range(1, 8))
    watched = {frozenset(map(link_of, names)) for names in pair_names(robot.collision_model)}
    assert frozenset(("left_link_5", "right_link_5")) in watched


def test_without_an_srdf_neighbours_and_pairs_that_touch_at_home_are_not_monitored() -> None:
    far = Robot.from_urdf(_urdf(4), {"left": "l4"})
    assert pair_names(far.collision_model) == (("l1_0", "l3_0"), ("l1_0", "l4_0"), ("l2_0", "l4_0"))
    fat = Robot.from_urdf(_urdf(4).replace('radius="0.1"', 'radius="0.31"'), {"left": "l4"})
    assert pair_names(fat.collision_model) == (("l1_0", "l4_0"),)
    assert fat.ignored_pairs == (("l1_0", "l3_0"), ("l2_0", "l4_0"))


def test_without_an_srdf_arms_are_monitored_even_if_they_overlap_each_other_or_an_obstacle_at_home() -> None:
    arms = _urdf(3).replace("</robot>", "").replace('"l', '"a_l').replace('"j', '"a_j') + _urdf(3).replace(
        '<robot name="chain">', ""
    ).replace("</robot>", "")
    post = '<link name="post"><collision><geometry><box size="0.1 0.1 2"/></geometry></collision></link>'
    joints = "".join(
        f'<joint name="to_{link}" type="fixed"><parent link="w"/><child link="{link}"/></joint>'
        for link in ("l0", "a_l0", "post")
    )
    robot = Robot.from_urdf(f'{arms}<link name="w"/>{post}{joints}</robot>', {"left": "l3", "right": "a_l3"})
    watched = set(map(frozenset, pair_names(robot.collision_model)))
    assert {frozenset(("l3_0", "a_l3_0")), frozenset(("l3_0", "post_0")), frozenset(("l1_0", "post_0"))} <= watched


def test_with_an_srdf_only_pairs_that_overlap_in_every_posture_are_not_monitored() -> None:
    """Links 1 and 3 are at most 0.6 m apart, and less at home, where the chain is bent."""
    bent = _urdf(3).replace('xyz="0 0 0.3"', 'xyz="0 0 0.3" rpy="0 1 0"')
    touching_at_home, touching_always = bent.replace("0.1", "0.28"), bent.replace("0.1", "0.301")
    assert Robot.from_urdf(touching_at_home, {"left": "l3"}, srdf="<robot/>").ignored_pairs == ()
    robot = Robot.from_urdf(touching_at_home, {"left": "l3"}, unchecked_links=["l3"])
    assert robot.ignored_pairs == (("l1_0", "l3_0"),)
    robot = Robot.from_urdf(touching_always, {"left": "l3"}, srdf="<robot/>", unchecked_links=["l3"])
    assert robot.ignored_pairs == (("l1_0", "l3_0"),)


@pytest.mark.parametrize(
    ("urdf", "complaint"),
    [
        pytest.param(
            _urdf(limit='lower="-1" upper="1" velocity="0" effort="1"'), "j1 has velocity limit 0", id="velocity zero"
        ),
        pytest.param(_urdf(limit='lower="-1" upper="1" velocity="inf" effort="1"'), "'inf'", id="velocity infinite"),
        pytest.param(_urdf(limit='lower="-1" upper="1" velocity="1"'), "joint j1 has effort limit 0", id="no torque"),
        pytest.param(_urdf(limit='lower="1" upper="-1" velocity="1" effort="1"'), "1 .. -1", id="limits swapped"),
        pytest.param(_urdf(kind="floating"), "joint j1 is floating", id="a floating joint in the arm"),
        pytest.param(
            _urdf().replace("<axis", '<mimic joint="j2"/><axis', 1), "joint j1 is mimic", id="a mimic joint in the arm"
        ),
        pytest.param("arm.urdf", "neither XML nor a file", id="a file that is not there"),
    ],
)  # fmt: skip
def test_a_robot_that_cannot_be_controlled_raises_an_error_of_one_line(urdf: str, complaint: str) -> None:
    with pytest.raises(RobotError) as error:
        Robot.from_urdf(urdf, {"left": "l3"})
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


BARE = """<robot name="rod"><link name="base"/><link name="rod"/><joint name="hinge" type="revolute">
<parent link="base"/><child link="rod"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.mark.parametrize(
    ("arms", "complaint"),
    [({}, "expected a mapping such as"), ({"left": "l9"}, "'l9'; links: l0, l1"), ({"left": "l0"}, "carries l0")],
)
def test_arms_that_the_urdf_does_not_have_are_refused(arms: dict[str, str], complaint: str) -> None:
    with pytest.raises(RobotError, match=complaint):
        Robot.from_urdf(_urdf(), arms)


def test_a_robot_without_shapes_monitors_no_pair_if_unchecked_links_names_its_link() -> None:
    robot = Robot.from_urdf(BARE, {"left": "rod"}, unchecked_links=["rod"])
    assert robot.distances(robot.home) == []
    assert robot.ignored_pairs == ()


@pytest.mark.slow
def test_a_link_and_a_fixed_joint_may_have_the_same_name() -> None:
    file = load_description("example-robot-data:z1").file
    robot = Robot.from_urdf(file, {"left": "gripperMover"}, unchecked_links=["link01", "link05"])
    assert robot.joint_names == (*(f"joint{number}" for number in range(1, 7)), "jointGripper")
    model = pin.buildModelFromUrdf(str(file))
    data = model.createData()
    q = np.linspace(0.1, 0.7, 7)
    pin.framesForwardKinematics(model, data, q)
    expected = data.oMf[model.getFrameId("gripperMover", pin.FrameType.BODY)]
    np.testing.assert_allclose(robot.tool_pose(q, "left").homogeneous, expected.homogeneous, atol=1e-12)
