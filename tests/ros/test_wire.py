"""Messages that are written and read as bytes equal the messages of rclpy and rosbags."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from tests.ros.conftest import need_ros

need_ros()

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.serde import SerdeError
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control import Robot, load_config
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.messages import STORE
from q2r2_control.ros.bridge.joint_outputs import TrajectoryOutput
from q2r2_control.ros.bridge.messages import (
    fill_pose,
    joint_state_message,
    joint_state_template,
    pose_template,
    stamped_pose,
)
from q2r2_control.ros.bridge.wire import joint_state_reader, read_pose, trajectory_reader, transforms_reader
from q2r2_control.ros.nodes.mujoco_robot import link_transforms
from q2r2_control.types import Command, CommandMode, RobotState
from tests.ros.arm_rig import stamped_transform
from tests.ros.processes import CONFIG

RNG = np.random.default_rng(3)
NAMES = [["a", "joint", "third_one"], ["a", "joint", "fourth_on"], ["one"], [f"long_name_{n}" for n in range(16)]]
TIMES = [0.0, 7.25, 1_795_957_121.000000001, 3.9999999999]


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("t", TIMES)
def test_joint_states_are_written_and_read_as_by_rclpy(names: list[str], t: float) -> None:
    q, v, tau = RNG.normal(size=(3, len(names)))
    data = joint_state_template(names).fill([*q, *v, *tau], t)
    assert deserialize_message(data, JointState) == joint_state_message(names, q, v, tau, t)
    none = np.zeros(0)
    data = joint_state_template(names, q=False, v=False).fill(tau.tolist(), t)
    assert deserialize_message(data, JointState) == joint_state_message(names, none, none, tau, t)


def test_joint_states_of_several_senders_are_read_correctly_whichever_fields_are_empty() -> None:
    read = joint_state_reader()
    for _ in range(3):
        for names in NAMES:
            for fields in ("position", "position velocity", "velocity", "position velocity effort", ""):
                values = {field: RNG.normal(size=len(names)).tolist() for field in fields.split()}
                message = JointState(name=names, **values)
                message.header.frame_id = "f" * int(RNG.integers(4))
                found = read(serialize_message(message))
                assert found.name == tuple(names)
                for field in ("position", "velocity", "effort"):
                    assert getattr(found, field).tolist() == values.get(field, [])
    message = JointState(name=["a"])
    assert read(message) is message


def test_bytes_that_are_not_a_message_are_refused() -> None:
    point = JointTrajectoryPoint(positions=[1.0])
    messages = {
        joint_state_reader(): JointState(name=["one"], position=[1.0], velocity=[2.0], effort=[3.0]),
        trajectory_reader(): JointTrajectory(joint_names=["one"], points=[point]),
        transforms_reader(): TFMessage(transforms=[stamped_transform("world", "a", pin.SE3.Identity())]),
        read_pose: stamped_pose(pin.SE3.Identity(), "world", 0.0),
    }
    for read, message in messages.items():
        whole = serialize_message(message)
        read(whole)
        text = 16 if isinstance(message, TFMessage) else 12  # Offset of the length of the first text.
        endless = whole[:text] + b"\xff\xff\xff\x7f" + whole[text + 4 :]
        for data in (whole[:24], endless, b"\x00\x00" + whole[2:], b""):
            with pytest.raises(SerdeError):
                read(data)


def test_a_trajectory_of_the_output_is_written_and_read_as_by_rclpy(robot: Robot) -> None:
    output, zero, read = TrajectoryOutput(0.004, robot), np.zeros(len(robot.home)), trajectory_reader()
    state = RobotState(robot.home, zero, zero, None, 0.0)
    for joints in (np.arange(14), robot.arms["left"].joints, np.arange(14)):
        names = [robot.joint_names[joint] for joint in joints]
        q, v = RNG.normal(size=(2, len(robot.home)))
        data = output.encode(Command(CommandMode.POSITION, q, v, zero, {}), state, 5.0, names, joints)
        point = JointTrajectoryPoint(positions=q[joints].tolist(), velocities=v[joints].tolist())
        point.time_from_start = Duration(sec=0, nanosec=4_000_000)
        assert deserialize_message(data, JointTrajectory) == JointTrajectory(joint_names=names, points=[point])
        found = read(data)
        assert (found.joint_names, len(found.points)) == (tuple(names), 1)
        assert found.points[0].positions.tolist() == q[joints].tolist()
        assert found.points[0].velocities.tolist() == v[joints].tolist()
        assert found.points[0].time_from_start == (0, 4_000_000)


@pytest.mark.parametrize("count", [0, 2])
def test_a_trajectory_that_does_not_have_exactly_one_point_keeps_its_number_of_points(count: int) -> None:
    points = [JointTrajectoryPoint(positions=[1.0 * n]) for n in range(count)]
    message = JointTrajectory(joint_names=["a"], points=points)
    assert len(trajectory_reader()(serialize_message(message)).points) == count


@pytest.mark.parametrize("frame", ["", "world", "left_link_0"])
@pytest.mark.parametrize("t", TIMES)
def test_poses_are_written_and_read_as_by_rclpy(frame: str, t: float) -> None:
    pose = pin.SE3.Random()
    data = fill_pose(pose_template(frame), pose, t)
    made, expected = deserialize_message(data, PoseStamped), stamped_pose(pose, frame, t)
    assert made.header == expected.header
    read = read_pose(data)
    assert read == read_pose(made)
    assert (read.frame, read.stamp) == (frame, made.header.stamp.sec * 1_000_000_000 + made.header.stamp.nanosec)
    np.testing.assert_allclose(read.numbers, read_pose(expected).numbers, atol=1e-15)


def test_transforms_of_several_senders_are_read_correctly() -> None:
    read = transforms_reader()
    for _ in range(3):
        for links in (["a"], ["b"], ["a", "bc"], ["ab", "c"], []):
            poses = [pin.SE3.Random() for _ in links]
            sent = [stamped_transform("world", name, pose) for name, pose in zip(links, poses, strict=True)]
            found = read(serialize_message(TFMessage(transforms=sent)))
            assert [(one.child, one.parent) for one in found] == [(name, "world") for name in links]
            for one, pose in zip(found, poses, strict=True):
                assert pin.XYZQUATToSE3(np.array(one.numbers)).isApprox(pose, 1e-12)


def test_in_its_parents_frame_each_link_has_the_same_pose_as_in_mujoco(robot: Robot) -> None:
    plant = MujocoPlant(robot, load_config(CONFIG))
    plant.reset(robot.home + 0.2)
    model, data = plant.model, plant.data
    for transforms in link_transforms(model, ()):
        found: Any = STORE.deserialize_cdr(transforms.at(data, 12.5), "tf2_msgs/msg/TFMessage")
        assert found.transforms
        for one in found.transforms:
            body, parent = (model.body(name).id for name in (one.child_frame_id, one.header.frame_id))
            inverse, p, q = np.zeros(4), np.zeros(3), np.zeros(4)
            mujoco.mju_negQuat(inverse, data.xquat[parent])
            mujoco.mju_rotVecQuat(p, data.xpos[body] - data.xpos[parent], inverse)
            mujoco.mju_mulQuat(q, inverse, data.xquat[body])
            to, turn = one.transform.translation, one.transform.rotation
            np.testing.assert_allclose([to.x, to.y, to.z], p, atol=1e-14)
            np.testing.assert_allclose([turn.w, turn.x, turn.y, turn.z], q, atol=1e-14)
            assert (one.header.stamp.sec, one.header.stamp.nanosec) == (12, 500_000_000)
    plant.close()
