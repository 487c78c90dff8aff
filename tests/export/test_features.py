"""Vectors have the numbers that their names say, whatever the arms do."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.export.features import MOTION, features
from q2r2_control.recording.tick_rows import NOT_MEASURED, POSE_FIELDS
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.support.processes import cell

pytestmark = pytest.mark.slow

COUNT = 60


@cache
def robot() -> Robot:
    return Robot.from_config(cell())


def poses(q: Array) -> list[Array]:
    return [pin.SE3ToXYZQUAT(robot().tool_pose(q, arm)) for arm in robot().arms]


def frames(seed: int = 0) -> dict[str, Array]:
    """Joints that move through much of their range, with targets at tools elsewhere."""
    random = np.random.default_rng(seed)

    def motion() -> Array:
        ends = random.uniform(robot().position_lower, robot().position_upper, (2, len(robot().joint_names)))
        return np.linspace(ends[0], ends[1], COUNT)

    position, reference = motion(), motion()
    return {
        "position": position,
        "velocity": random.normal(size=position.shape),
        "effort": random.normal(size=position.shape),
        "opening": random.uniform(size=(COUNT, 2)),
        "reference": reference,
        "gripper": random.uniform(size=(COUNT, 2)),
        "target": np.array([poses(q) for q in motion()]),
        "reference_tool": np.array([poses(q) for q in reference]),
    }


def test_every_number_has_the_name_of_its_joint_or_gripper() -> None:
    given = frames()
    vectors, names = features(given, robot())
    for index, joint in enumerate(robot().joint_names):
        for feature, what in (
            ("observation.state", "position"),
            ("observation.velocity", "velocity"),
            ("observation.effort", "effort"),
            ("action", "reference"),
        ):
            column = vectors[feature][:, names[feature].index(joint)]
            np.testing.assert_array_equal(column, given[what][:, index].astype(np.float32))
    for feature, what in (("observation.state", "opening"), ("action", "gripper")):
        for index, arm in enumerate(robot().arms):
            column = vectors[feature][:, names[feature].index(f"{arm}_gripper")]
            np.testing.assert_array_equal(column, given[what][:, index].astype(np.float32))


def test_tools_are_where_the_measured_joints_put_them() -> None:
    given = frames()
    vectors, names = features(given, robot())
    for arm in robot().arms:
        at = [names["observation.tool"].index(f"{arm}_{number}") for number in POSE_FIELDS]
        for q, pose in zip(given["position"], vectors["observation.tool"][:, at], strict=True):
            off = robot().tool_pose(q, arm).actInv(pin.XYZQUATToSE3(pose.astype(np.float64)))
            assert np.linalg.norm(pin.log6(off).vector) < 1e-5


def test_tool_deltas_lead_from_each_target_to_the_next_and_nowhere_from_the_last() -> None:
    vectors, names = features(frames(), robot())
    for arm in robot().arms:
        targets = vectors["action.tool"][:, [names["action.tool"].index(f"{arm}_{number}") for number in POSE_FIELDS]]
        at = [names["action.tool_delta"].index(f"{arm}_{number}") for number in MOTION]
        deltas = vectors["action.tool_delta"][:, at].astype(np.float64)
        places = [pin.XYZQUATToSE3(pose.astype(np.float64)) for pose in targets]
        for now, then, delta in zip(places, places[1:], deltas, strict=False):
            reached = now * pin.SE3(pin.exp3(delta[3:]), delta[:3])
            assert np.linalg.norm(pin.log6(then.actInv(reached)).vector) < 1e-4
        assert not deltas[-1].any()


def test_quaternions_do_not_jump_and_targets_are_on_the_side_of_the_tools() -> None:
    flipped = 0
    for seed in range(5):
        given = frames(seed)
        vectors, names = features(given, robot())
        first = {}
        for feature in ("observation.tool", "action.tool"):
            for arm in robot().arms:
                at = [names[feature].index(f"{arm}_{number}") for number in POSE_FIELDS[3:]]
                quaternions = vectors[feature][:, at]
                assert (np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0.0).all()
                first[feature, arm] = quaternions[0]
        for arm in robot().arms:
            assert np.dot(first["observation.tool", arm], first["action.tool", arm]) >= 0.0
            assert first["observation.tool", arm][np.abs(first["observation.tool", arm]).argmax()] > 0.0
        recorded = given["target"][..., 3:]
        flipped += int((np.sum(recorded[1:] * recorded[:-1], axis=-1) < 0.0).any())
    assert flipped  # without which this would show nothing


def test_grippers_that_are_never_measured_are_left_out() -> None:
    given = frames()
    given["opening"][:, 1] = NOT_MEASURED
    vectors, names = features(given, robot())
    assert names["observation.state"] == (*robot().joint_names, "left_gripper")
    assert vectors["observation.state"].shape == (COUNT, 15)
    given["opening"][:3, 0] = NOT_MEASURED
    with pytest.raises(RecordingError, match="the opening of arm left is not known at frame 0"):
        features(given, robot())


def test_what_is_no_number_is_named() -> None:
    given = frames()
    given["effort"][7, 2] = np.nan
    with pytest.raises(RecordingError, match=rf"observation.effort\[{robot().joint_names[2]}\] .* at frame 7"):
        features(given, robot())


def test_another_robot_than_the_recorded_one_is_refused() -> None:
    given = frames()
    given["reference_tool"][:, 0, 2] += 1e-4
    with pytest.raises(RecordingError, match="not the recorded one"):
        features(given, robot())
