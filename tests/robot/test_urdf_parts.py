"""Acceleration limits of joints: their attributes in a URDF, their replacement by the cell's YAML, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.robot import Robot
from tests.robot.conftest import one_arm


def rod(limit: str) -> str:
    """Return a URDF of one joint with ``limit`` among its limits."""
    return (
        '<robot name="rod" xmlns:drake="http://drake.mit.edu"><link name="base"/><link name="rod"/>'
        '<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>'
        f'<limit lower="-1" upper="1" velocity="1" effort="1" {limit}/></joint></robot>'
    )


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        pytest.param("", np.inf, id="a URDF that says none has none"),
        pytest.param('acceleration="4.5"', 4.5, id="as URDF 1.2 writes it"),
        pytest.param('acceleration="4.5" deceleration="3"', 3.0, id="a joint that brakes less than it speeds up"),
        pytest.param('acceleration="4.5" deceleration="6"', 4.5, id="a joint that brakes more than it speeds up"),
        pytest.param('deceleration="6"', 6.0, id="only a deceleration"),
        pytest.param('drake:acceleration="7.25"', 7.25, id="as Drake writes it"),
    ],
)
def test_the_acceleration_limit_of_a_joint_is_the_least_one_in_its_model(limit: str, expected: float) -> None:
    robot = Robot.from_urdf(rod(limit), {"left": "rod"}, unchecked_links=["rod"])
    assert robot.acceleration_limit.tolist() == [expected]
    assert robot.capped_acceleration(5.0).tolist() == [min(expected, 5.0)]
    again = Robot.from_urdf(robot.urdf, {"left": "rod"}, unchecked_links=["rod"])
    assert again.acceleration_limit.tolist() == [expected], "the URDF that a robot carries says the same"


@pytest.mark.parametrize(
    ("limit", "complaint"),
    [
        ('acceleration="0"', "joint hinge has acceleration limit 0; expected more than 0, or none"),
        ('acceleration="-3"', "joint hinge has acceleration limit -3; expected more than 0, or none"),
        ('deceleration="-3" acceleration="3"', "joint hinge has acceleration limit -3"),
        ('acceleration="fast"', "<limit> has acceleration = 'fast'; allowed: 1 finite number(s)"),
        ('acceleration="nan"', "<limit> has acceleration = 'nan'; allowed: 1 finite number(s)"),
        ('drake:acceleration="inf"', "acceleration = 'inf'; allowed: 1 finite number(s)"),
    ],
)
def test_an_invalid_acceleration_limit_raises_an_error_of_one_line(limit: str, complaint: str) -> None:
    with pytest.raises(RobotError) as error:
        Robot.from_urdf(rod(limit), {"left": "rod"}, unchecked_links=["rod"])
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_the_file_of_a_cell_replaces_the_acceleration_limits_of_the_joints_that_it_names() -> None:
    robot = Robot.from_config(one_arm(acceleration_limit={"A2": 4.0, "A4": 12.0}))
    assert robot.acceleration_limit.tolist() == [8.65, 4.0, 5.69, 12.0, 11.78, 13.76, 13.17]


@pytest.mark.parametrize("name", ["A8", "left_A2", "flange", "finger_joint_1"])
def test_the_error_about_a_joint_that_does_not_belong_to_the_arm_lists_the_joints_that_do(name: str) -> None:
    cell = one_arm(tool={"model": "hand_e"}, acceleration_limit={name: 4.0})
    with pytest.raises(ConfigError) as error:
        Robot.from_config(cell)
    line = f"arms.left.acceleration_limit.{name}: no joint of the arm; allowed: A1, A2, A3, A4, A5, A6, A7"
    assert str(error.value) == line
