"""What is read of messages, and which are refused: a state of all joints, a pose."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.ros.conftest import need_ros

need_ros()

from geometry_msgs.msg import Point, Pose, Quaternion
from sensor_msgs.msg import JointState

from q2r2_control.ros.bridge.messages import pose_of, robot_state
from q2r2_control.types import RobotState

NAMES = ("a", "b", "c")
TURN = {"z": 0.6, "w": 0.8}


def joint_state(**changes: Any) -> JointState:
    fields = {"name": ["c", "finger", "a", "b"], "position": [3.0, 9.0, 1.0, 2.0], "velocity": [0.3, 0.9, 0.1, 0.2]}
    return JointState(**(fields | changes))


def test_joints_are_matched_by_name_and_torques_may_be_missing() -> None:
    state = robot_state(joint_state(), NAMES, 7.0)
    assert isinstance(state, RobotState)
    assert (state.q.tolist(), state.v.tolist(), state.tau.tolist()) == ([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], [0.0] * 3)
    assert state.stamp == 7.0


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"name": ["c", "finger", "b", "b"]}, "a joint is named twice"),
        ({"name": ["c", "finger", "other", "b"]}, "no joint a"),
        ({"position": [3.0, 9.0, math.nan, 2.0]}, "position of a is not finite"),
        ({"velocity": [math.inf, 0.9, 0.1, 0.2]}, "velocity of c is not finite"),
        ({"position": [3.0, 9.0, 1.0]}, "3 position values for 4 joints"),
        ({"position": []}, "0 position values for 4 joints"),
    ],
)
def test_a_state_that_is_none_is_refused_by_name(changes: dict[str, Any], fault: str) -> None:
    assert robot_state(joint_state(**changes), NAMES, 0.0) == fault


def test_what_is_not_finite_about_a_joint_of_others_is_no_fault() -> None:
    assert isinstance(robot_state(joint_state(position=[3.0, math.nan, 1.0, 2.0]), NAMES, 0.0), RobotState)


def test_a_pose_is_read_with_its_quaternion_normalized() -> None:
    pose = pose_of(Pose(position=Point(x=1.0), orientation=Quaternion(z=0.6003, w=0.8004)))
    assert pose is not None
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("position", "orientation"),
    [({"x": math.nan}, TURN), ({"y": math.inf}, TURN), ({}, {"w": 0.0}), ({}, {"w": 1.1}), ({}, {"w": math.nan})],
)
def test_numbers_that_are_no_pose_are_none(position: dict[str, float], orientation: dict[str, float]) -> None:
    assert pose_of(Pose(position=Point(**position), orientation=Quaternion(**orientation))) is None
