"""A finger's body for known openings contains the finger tightly, and is never larger for a narrower interval."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.finger_bodies import FingerBody, collision_model_at
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval

INTERVALS: tuple[Interval, ...] = ((0.0, 0.0), (0.0, 0.3), (0.2, 0.6), (0.5, 0.5), (0.9, 1.0), ALL_OF_THE_WAY)
HAND_E = load_config("config/dual_iiwa7.yaml")
LIMITS = 'velocity="1" effort="10"'


def hand(mimic: str = "", axis: str = "0 -1 0", stroke: tuple[float, float] = (0.03, 0.0)) -> str:
    """Return a hand whose fingers are spheres on two lines. The second finger may mimic the first."""
    ball = '<collision><geometry><sphere radius="0.008"/></geometry></collision>'
    limit = f'<limit lower="{min(stroke) - 0.002}" upper="{max(stroke) + 0.002}" {LIMITS}/>'
    return f"""<robot name="hand"><link name="palm"/><link name="one">{ball}</link><link name="two">{ball}</link>
        <joint name="slide" type="prismatic"><parent link="palm"/><child link="one"/><origin xyz="0 0.01 0.1"/>
        <axis xyz="0 1 0"/>{limit}</joint>
        <joint name="other" type="prismatic"><parent link="palm"/><child link="two"/><origin xyz="0.02 -0.01 0.1"/>
        <axis xyz="{axis}"/>{limit.replace("-0.002", "-0.1") if mimic else limit}{mimic}</joint></robot>"""


def cell(urdf: str, joints: tuple[str, ...], folder: str, positions: tuple[float, float]) -> Robot:
    path = f"{folder}/hand.urdf"
    with open(path, "w", encoding="utf-8") as file:
        file.write(urdf)
    data = HAND_E.model_dump()
    for arm in data["arms"].values():
        arm["tool"] = {"model": path, "frame": "palm"}
        arm["gripper"] |= {"joints": joints, "open_position": positions[0], "closed_position": positions[1]}
    return Robot.from_config(Config.model_validate(data))


def ends_at(robot: Robot, name: str, interval: Interval) -> tuple[Array, Array]:
    made = collision_model_at(robot.collision_model, robot.finger_bodies, {"left": interval})
    item = made.geometryObjects[made.getGeometryId(name)]
    half = item.geometry.halfLength * item.placement.rotation[:, 2]
    return item.placement.translation - half, item.placement.translation + half


def outside(point: Array, ends: tuple[Array, Array]) -> float:
    """Return the distance of a point from a segment [m]."""
    along = ends[1] - ends[0]
    share = float(np.clip((point - ends[0]) @ along / max(float(along @ along), 1e-30), 0.0, 1.0))
    return float(np.linalg.norm(point - ends[0] - share * along))


def finger_at(robot: Robot, joint: str, position: float, points: Array) -> Array:
    """Return points of a finger's link in the frame of the arm's last joint. The finger's joint is at ``position``."""
    full = pin.buildModelFromXML(robot.urdf)
    q = pin.neutral(full)
    q[full.joints[full.getJointId(joint)].idx_q] = position
    data = full.createData()
    pin.forwardKinematics(full, data, q)
    last = data.oMi[full.getJointId(robot.joint_names[int(robot.arms["left"].joints[-1])])]
    local = last.inverse() * data.oMi[full.getJointId(joint)]
    return np.array([local.act(point) for point in points])


def test_the_body_of_the_hand_e_contains_both_fingers_at_each_opening_of_the_interval() -> None:
    robot = Robot.from_config(HAND_E)
    # For each finger, both ends of a capsule around its tip in robots/hand_e.urdf, in the frame of its link [m].
    drawn = {1: np.array([[0.00825, 0.0, 0.03725], [0.00825, 0.012, 0.03725]])}
    drawn[2] = drawn[1] * [1.0, -1.0, 1.0]
    name = "left_hand_e_finger_1_envelope_3"
    for interval in INTERVALS:
        ends = ends_at(robot, name, interval)
        for opening in np.linspace(*interval, 5):
            for finger, points in drawn.items():
                for point in finger_at(robot, f"left_finger_joint_{finger}", 0.025 * opening, points):
                    assert outside(point, ends) <= 1e-9, (interval, opening, finger)


@pytest.mark.parametrize("positions", [(0.03, 0.0), (0.0, 0.03)], ids=["opens outwards", "opens inwards"])
def test_fingers_on_two_lines_have_separate_bodies(positions: tuple[float, float], tmp_path: object) -> None:
    robot = cell(hand(), ("slide", "other"), str(tmp_path), positions)
    assert {body.name for body in robot.finger_bodies if body.arm == "left"} == {"left_one_0", "left_two_0"}
    opened, closed = positions
    for interval in INTERVALS:
        for name, joint in (("left_one_0", "left_slide"), ("left_two_0", "left_other")):
            ends = ends_at(robot, name, interval)
            for opening in np.linspace(*interval, 5):
                (point,) = finger_at(robot, joint, closed + opening * (opened - closed), np.zeros((1, 3)))
                assert outside(point, ends) <= 1e-9, (interval, opening, name)
            beyond = 0.002 * ((interval[0] == 0.0) + (interval[1] == 1.0))
            assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.03 * np.ptp(interval) + beyond, abs=1e-9)


def test_the_body_of_a_finger_that_mimics_another_finger_is_where_the_mimic_puts_the_finger(tmp_path: object) -> None:
    mimic = '<mimic joint="slide" multiplier="-0.5" offset="0.001"/>'
    robot = cell(hand(mimic, axis="0 1 0"), ("slide",), str(tmp_path), (0.03, 0.0))
    ends = ends_at(robot, "left_two_0", (0.2, 0.6))
    for opening in (0.2, 0.4, 0.6):
        (point,) = finger_at(robot, "left_other", -0.5 * 0.03 * opening + 0.001, np.zeros((1, 3)))
        assert outside(point, ends) <= 1e-9
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.5 * 0.03 * 0.4, abs=1e-9)


def test_the_body_for_a_wider_interval_of_openings_contains_the_body_for_an_interval_within_it() -> None:
    robot, random = Robot.from_config(HAND_E), np.random.default_rng(0)
    for body in robot.finger_bodies:
        assert isinstance(body, FingerBody)
        for _ in range(50):
            a, b, c, d = np.sort(random.random(4))
            inner, outer = body.part((b, c)), body.part((a, d))
            assert 0.0 <= outer[0] <= inner[0] <= inner[1] <= outer[1] <= 1.0
        assert body.part(ALL_OF_THE_WAY) == (0.0, 1.0)


def test_bodies_cover_all_positions_of_fingers_if_closed_and_open_positions_are_unknown() -> None:
    made = Robot.from_config(HAND_E)
    plain = Robot.from_urdf(made.urdf, {arm.name: arm.tool_frame for arm in made.arms.values()})
    assert plain.finger_bodies == ()
    assert plain.arms["left"].stroke == 0.0
    assert made.arms["left"].stroke == pytest.approx(0.025)
