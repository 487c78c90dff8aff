"""The simulated robot as a ROS process: its topics, its commands, and its behaviour when commands end."""

from __future__ import annotations

import os
import signal
import time
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, PATIENCE, Processes

need_ros()

from control_msgs.action import GripperCommand
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.ros.base_node import COMMAND_QOS, LATCHED_QOS
from q2r2_control.ros.bridge.messages import nanoseconds
from tests.ros.cell import Cell
from tests.ros.processes import subscribed, wait_until

FINGERS = tuple(f"{side}_finger_joint_{number}" for side in ("left", "right") for number in (1, 2))


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cell:
    cell = Cell(module_node, robot, module_processes.start_node("mujoco_robot", f"config:={CONFIG}"))
    wait_until(lambda: cell.joints.states, "joint states come")
    return cell


@pytest.fixture
def cell(started: Cell, robot: Robot) -> Cell:
    """Return a cell at home, at rest, without commands."""
    wait_until(lambda: started.state("mode", "mujoco_robot") == "holding", "the robot holds")
    started.call("/mujoco_robot/reset")
    wait_until(lambda: np.abs(started.q - robot.home).max() < 1e-3, "the arms are at home")
    return started


def publish_steadily(publisher: Any, messages: list[Any], period: float = 0.01) -> None:
    wait_until(publisher.get_subscription_count, "commands are listened to")
    for message in messages:
        publisher.publish(message)
        time.sleep(period)


def trajectory(robot: Robot, q: np.ndarray, names: tuple[str, ...] | None = None) -> JointTrajectory:
    return JointTrajectory(
        joint_names=list(names or robot.joint_names), points=[JointTrajectoryPoint(positions=q.tolist())]
    )


def test_in_its_parents_frame_each_link_has_the_pose_that_robot_state_publisher_would_publish(
    cell: Cell, robot: Robot
) -> None:
    joints = [joint for joint in ElementTree.fromstring(robot.urdf) if joint.tag == "joint"]
    links: list[Any] = [(joint.find("child"), joint.find("parent")) for joint in joints]
    parents = {child.attrib["link"]: parent.attrib["link"] for child, parent in links}
    wait_until(lambda: cell.parents.keys() >= parents.keys(), "all links are on /tf or /tf_static")
    assert cell.parents == parents

    state = subscribed(cell.node, JointState, "/joint_states").get(timeout=PATIENCE)
    assert list(state.name) == [*robot.joint_names, *FINGERS]
    description = subscribed(cell.node, String, "/robot_description", LATCHED_QOS)
    assert description.get(timeout=PATIENCE).data == robot.urdf
    model = pin.buildModelFromXML(robot.urdf)
    data, q = model.createData(), pin.neutral(model)
    for name, position in zip(state.name, state.position, strict=True):
        q[model.joints[model.getJointId(name)].idx_q] = position
    pin.framesForwardKinematics(model, data, q)
    placements = {frame.name: data.oMf[number] for number, frame in enumerate(model.frames) if frame.type == pin.BODY}
    for child, parent in parents.items():
        found = cell.frames.find(child, parent)
        assert found is not None
        expected = placements[parent].actInv(placements[child])
        assert np.allclose(found.pose.homogeneous, expected.homogeneous, atol=1e-3), child


@pytest.mark.parametrize("kind", ["joint_trajectory", "joint_commands", "position_commands"])
def test_the_robot_follows_positions_in_any_order_of_names_and_stays_there(cell: Cell, robot: Robot, kind: str) -> None:
    postures = [robot.home.copy() for _ in range(80)]
    for step, q in enumerate(postures, 1):
        q[0] += 0.2 * min(step / 50, 1.0)
    order = np.random.default_rng(1).permutation(len(robot.joint_names))
    names = [robot.joint_names[index] for index in order]
    make = {
        "joint_trajectory": lambda q: trajectory(robot, q[order], tuple(names)),
        "joint_commands": lambda q: JointState(name=names, position=q[order].tolist()),
        "position_commands": lambda q: Float64MultiArray(data=q.tolist()),
    }
    messages: list[Any] = list(map(make[kind], postures))
    publish_steadily(cell.node.create_publisher(type(messages[0]), kind, COMMAND_QOS), messages)
    wait_until(lambda: cell.state("mode", "mujoco_robot") == "holding", "the robot holds")
    assert np.abs(cell.joints.wait_for_rest() - postures[-1]).max() < 0.01


def test_two_senders_on_one_topic_may_command_one_arm_each(cell: Cell, robot: Robot) -> None:
    joints = {arm: robot.arms[arm].joints for arm in robot.arms}
    senders = {arm: cell.node.create_publisher(JointTrajectory, "joint_trajectory", COMMAND_QOS) for arm in joints}
    for sender in senders.values():
        wait_until(sender.get_subscription_count, "commands are listened to")
    for way in (0.02, 0.04, 0.02, 0.0, 0.02, 0.04):
        goal = robot.home + way
        os.kill(cell.processes[0].pid, signal.SIGSTOP)
        for arm, its in joints.items():
            senders[arm].publish(trajectory(robot, goal[its], tuple(robot.joint_names[joint] for joint in its)))
        time.sleep(0.05)
        os.kill(cell.processes[0].pid, signal.SIGCONT)  # Both commands have arrived before one is taken.
        wait_until(partial(is_at, cell, goal), "both arms are there")


def is_at(cell: Cell, q: np.ndarray) -> bool:
    return bool(np.abs(cell.q - q).max() < 5e-3)


def test_commands_that_cannot_be_followed_move_nothing_and_are_reported_once(cell: Cell, robot: Robot) -> None:
    publisher = cell.node.create_publisher(JointTrajectory, "joint_trajectory", COMMAND_QOS)

    def refused() -> int:
        return int(cell.state("refused_commands", "mujoco_robot"))

    for message in (trajectory(robot, robot.home + 0.5), JointTrajectory(joint_names=list(robot.joint_names))):
        before = refused()
        publish_steadily(publisher, [message] * 10)
        while refused() == before:
            time.sleep(0.05)
        assert np.abs(cell.q - robot.home).max() < 5e-3
        assert cell.state("level", "mujoco_robot") == "warn"
    assert cell.processes[0].output.count("joint_trajectory: refused") == 1


def test_an_empty_gripper_closes_opens_and_refuses_unreachable_goals(cell: Cell) -> None:
    client = ActionClient(cell.node, GripperCommand, "/q2r2/left_gripper/gripper_cmd")
    assert client.wait_for_server(PATIENCE)
    for position in (0.05, 0.0):
        result = result_of(client, position)
        assert result.reached_goal
        assert not result.stalled
        assert result.position == pytest.approx(position, abs=2e-3)
    assert result_of(client, 0.2) is None


def result_of(client: ActionClient, position: float) -> Any:
    goal = GripperCommand.Goal()
    goal.command.position, goal.command.max_effort = position, 5.0
    sent = client.send_goal_async(goal)
    wait_until(sent.done, "the goal is answered")
    if not sent.result().accepted:
        return None
    ended = sent.result().get_result_async()
    wait_until(ended.done, "the goal has ended")
    return ended.result().result


def test_external_torques_have_the_stamp_of_the_joint_states_of_the_same_tick(cell: Cell) -> None:
    stamps: dict[str, list[int]] = {"/joint_states": [], "/mujoco_robot/external_torque": []}

    for topic, its in stamps.items():
        note = lambda message, its=its: its.append(nanoseconds(message.header.stamp))  # noqa: E731
        cell.node.create_subscription(JointState, topic, note, 1000)
    states, torques = stamps.values()
    wait_until(lambda: len(set(torques) & set(states)) > 10, "torques come with the stamps of joint states")
