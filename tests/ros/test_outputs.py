"""Outputs send messages and notice receivers that are silent or new. Hands feel the controller's reports."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.events import Reason
from q2r2_control.loop.control_loop import ArmConditions
from q2r2_control.ros.reasons import RosReason
from q2r2_control.types import SIDES, ActiveLimit, LimitKind, RobotState
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, Processes, RosProcess, as_arguments, subscribed, wait_until

need_ros()

from geometry_msgs.msg import PoseStamped
from rclpy.qos import qos_profile_sensor_data
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from q2r2_control import load_config
from q2r2_control.drives.base import make_drive
from q2r2_control.errors import ConfigError
from q2r2_control.ros.base_node import COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge import joint_outputs
from q2r2_control.ros.bridge.arm_feedback import ConditionPublishers, listen_to_condition
from q2r2_control.ros.bridge.joint_outputs import Channel, JointOutput, PositionArray, TorqueArray, make_output
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.monitoring import WatchedPublisher, node_of
from q2r2_control.ros.nodes.arm_controllers import LeftArmController
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.teleop.haptics import ArmCondition
from q2r2_control.types import Command, CommandMode

TIMEOUT = 0.5  # The timeout is longer than a busy machine needs to acknowledge [s].


class Stream:
    def __init__(self, publisher: WatchedPublisher, rate: float, message: type = PoseStamped) -> None:
        self._publisher, self._period, self._message = publisher, 1.0 / rate, message
        self.published = self.left_out = 0

    def run(self, seconds: float, fault: Callable[[], Reason | None] | None = None) -> Reason | None:
        """Publish for ``seconds``, or until ``fault`` returns a reason. Return this reason; None if there was none.

        By default, ``fault`` returns a reason if a listener is silent.
        """
        end, find = time.monotonic() + seconds, fault or self._publisher.silence
        while time.monotonic() < end:
            if (found := find()) is not None:
                return found
            if self._publisher.waits():
                self.left_out += 1
            else:
                self._publisher.publish(self._message(), time.monotonic())
                self.published += 1
            time.sleep(self._period)
        return None


class Commands:
    def __init__(self, node: Any, positions: bool) -> None:
        self._node, self.taken = node, 0
        self._publisher = WatchedPublisher(node, Float64MultiArray, "/commands", TIMEOUT)
        config, kind = load_config(CONFIG), PositionArray if positions else TorqueArray
        robot = Robot.from_config(config)
        drive = make_drive(kind.mode, robot, config, has_servos=False)
        self.output = JointOutput(drive, kind(0.004, robot), [Channel([], np.arange(0), self._publisher)])
        self.listen()

    def listen(self) -> None:
        known = self._publisher.listeners
        self._node.create_subscription(Float64MultiArray, "/commands", self._take, COMMAND_QOS)
        wait_until(lambda: self._publisher.listeners > known, "the listener is found")

    def send(self, seconds: float, off_reference: bool) -> Reason | None:
        """Send 200 commands a second, and return the fault that was found, if any."""
        stream = Stream(self._publisher, 200.0, Float64MultiArray)
        return stream.run(seconds, lambda: self.output.listener_fault(off_reference))

    def _take(self, message: Float64MultiArray) -> None:
        self.taken += 1


def test_a_known_receiver_of_positions_still_gets_commands_while_the_arms_are_off_their_reference(node: Any) -> None:
    commands = Commands(node, positions=True)
    assert commands.send(0.2, off_reference=False) is None
    before = commands.taken
    assert commands.send(3.0 * TIMEOUT, off_reference=True) is None
    # About 300 commands are due. Some of them may be left out, or late on a busy machine.
    assert commands.taken - before > 100


@pytest.mark.parametrize(("positions", "off_reference"), [(True, True), (True, False), (False, True)])
def test_a_new_receiver_of_positions_is_a_fault_only_while_arms_are_off_their_reference(
    positions: bool, off_reference: bool, node: Any
) -> None:
    commands = Commands(node, positions)
    assert commands.send(0.2, off_reference=False) is None
    commands.listen()
    fault = commands.send(0.2, off_reference)
    assert (fault is not None and fault.kind is RosReason.NEW_RECEIVER) == (positions and off_reference)


def test_arms_with_separate_command_topics_get_only_their_own_joints_on_their_topic(
    node: Any, robot: Robot, context: Any
) -> None:
    # The right arm's topic comes from the pattern for all arms, and the left arm's topic from its own setting.
    given = ("output_topic:=/{arm}/commands", "left.output_topic:=/left/commands")
    sender = BaseNode("sender", context=context, cli_args=as_arguments(*given))
    output = make_output("trajectory", sender, robot, load_config(CONFIG), 0.004)
    assert set(output.sent) == {"/left/commands", "/right/commands"}
    taken = subscribed(node, JointTrajectory, "/right/commands", COMMAND_QOS)
    q, zero = robot.home, np.zeros_like(robot.home)
    state = RobotState(q, zero, zero, None, 0.0)
    command = Command(CommandMode.POSITION, q, zero, zero, {})
    wait_until(lambda: sender.count_subscribers("/right/commands"), "the listener is found")
    while taken.empty():
        output.send(command, state, 0.0, time.monotonic())
        time.sleep(0.02)
    message = taken.get()
    assert message.joint_names == [name for name in robot.joint_names if name.startswith("right")]
    assert list(message.points[0].positions) == q[robot.arms["right"].joints].tolist()
    sender.destroy_node()


def test_torques_for_an_lbr_do_not_contain_gravity(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "lbr_fri_idl.msg", None)
        with pytest.raises(ConfigError, match="lbr_fri_idl cannot be imported"):
            joint_outputs.LbrTorque(0.004, robot)
    q, zero = robot.home + 0.1, np.zeros_like(robot.home)
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    command = Command(CommandMode.TORQUE, robot.home, zero, gravity + 1.0, {})
    joints = robot.arms["left"].joints
    to_send = command, RobotState(q, zero, zero, None, 0.0), 0.0
    sent = joint_outputs.LbrTorque(0.004, robot).encode(*to_send, [], joints)
    np.testing.assert_allclose(sent.torque, 1.0)
    np.testing.assert_array_equal(sent.joint_position, q[joints])
    sent = joint_outputs.LbrPosition(0.004, robot).encode(*to_send, [], joints)
    np.testing.assert_array_equal(sent.joint_position, robot.home[joints])


PUSH = np.array([0.0, 0.0, 20.0])  # Force on the left tool [N].


def test_the_spare_distance_the_joint_limits_and_the_contact_force_of_each_arm_are_reported(
    node: Any, robot: Robot
) -> None:
    controller = CartesianController(robot)
    controller.reset(robot.home)
    told: dict[str, ArmCondition] = {}
    for arm in SIDES:
        listen_to_condition(node, "/test", arm, partial(told.__setitem__, arm))
    publishers = ConditionPublishers(node, SIDES, ArmConditions(controller))
    zero, data = np.zeros_like(robot.home), robot.model.createData()
    frame = robot.arms["left"].frame_id
    J = pin.computeFrameJacobian(robot.model, data, robot.home, frame, pin.LOCAL_WORLD_ALIGNED)
    felt = RobotState(q=robot.home, v=zero, tau=zero, tau_external=J[:3].T @ PUSH, stamp=0.0)
    binding = ActiveLimit(LimitKind.POSITION, ("left_A4",)), ActiveLimit(LimitKind.VELOCITY, ("right_A2",))
    report = replace(controller.step({}, 0.004).report, binding=binding)
    now = 0.0

    def comes(state: RobotState) -> bool:
        nonlocal now
        now += 0.05
        publishers.update(report, state, now)
        left = told.get("left")
        return left is not None and len(told) == 2 and (left.force is None) is (state.tau_external is None)

    wait_until(lambda: comes(felt), "both arms are told of")
    assert told["left"].force == pytest.approx(20.0, rel=0.01)
    assert told["right"].force == pytest.approx(0.0, abs=1e-6)
    assert (told["left"].limits, told["right"].limits) == ({"left_A4"}, set())
    for arm in SIDES:
        assert told[arm].spare == pytest.approx(controller.spare_distance(arm))
    wait_until(lambda: comes(replace(felt, tau_external=None)), "no force is told where none is measured")


@pytest.mark.parametrize(("state", "ends"), [(ArmState.PAUSED, 1), (ArmState.LOST, 0)])
def test_a_stream_reports_its_end_only_if_its_operator_paused_the_arm(
    state: ArmState, ends: int, node: Any, context: Any
) -> None:
    arm, at = LeftArmController(context=context), pin.SE3.Identity()
    output = arm.outputs.first
    targets, ended = subscribed(node, PoseStamped, output.topic), subscribed(node, Empty, f"{output.topic}/ended")
    (end,) = (one for one in arm.publishers if one.topic_name == f"{output.topic}/ended")

    def step(target: pin.SE3 | None, state: ArmState) -> int:
        """Return how many targets have come."""
        now = time.monotonic()
        output.take_fault(now)
        output.step(target, at, at, now, now, state=state)
        time.sleep(0.01)
        return targets.qsize()

    wait_until(lambda: step(at, ArmState.ENGAGED), "targets come")
    wait_until(end.get_subscription_count, "its end would be heard")
    for _ in range(50):
        step(None, state)
    assert ended.qsize() == ends
    arm.destroy_node()


_LOST = "_NODE_NAME_UNKNOWN_"  # rcl gives this name to a node whose name it does not know.
LISTENER = """
import rclpy
from geometry_msgs.msg import PoseStamped
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(PoseStamped, "watched", lambda message: None, 1)
rclpy.spin(node)
"""


@pytest.fixture
def listener(processes: Processes) -> RosProcess:
    return processes.start(sys.executable, "-c", LISTENER, name="listener")


@pytest.mark.parametrize(("rate", "acknowledged"), [(50.0, False), (500.0, True)])
def test_only_a_frozen_listener_is_reported(rate: float, acknowledged: bool, node: Any, listener: RosProcess) -> None:
    publisher = WatchedPublisher(node, PoseStamped, "/watched", TIMEOUT)
    wait_until(lambda: publisher.listeners == 1, "the listener is found")
    publisher.begin(acknowledged)
    stream = Stream(publisher, rate)
    assert stream.run(2.0) is None
    assert stream.published > stream.left_out
    os.kill(listener.pid, signal.SIGSTOP)
    silence = stream.run(10.0 * TIMEOUT)
    assert silence is not None
    assert (silence.kind, silence.detail["topic"]) == (RosReason.NOT_ACKNOWLEDGED, "/watched")
    assert TIMEOUT < silence.detail["age"] < 1.0
    os.kill(listener.pid, signal.SIGCONT)
    wait_until(lambda: publisher.silence() is None, "it is there again")


def test_a_listener_that_ended_before_the_stream_began_is_not_reported(
    node: Any, listener: RosProcess, processes: Processes
) -> None:
    publisher = WatchedPublisher(node, PoseStamped, "/watched", TIMEOUT)
    wait_until(lambda: publisher.listeners == 1, "the listener is found")
    os.kill(listener.pid, signal.SIGKILL)
    listener.wait()
    publisher.begin()
    assert Stream(publisher, 100.0).run(3.0 * TIMEOUT) is None
    assert publisher.listeners == 1  # The graph still lists the listener.


def test_an_endpoint_keeps_the_name_of_its_node_after_the_graph_has_lost_this_name() -> None:
    known, lost, other = (
        TopicEndpointInfo(node_namespace=space, node_name=name, endpoint_gid=[number] * 16)
        for space, name, number in (("/", "talker", 1), ("_NODE_NAMESPACE_UNKNOWN_", _LOST, 1), ("/", _LOST, 2))
    )
    assert [node_of(one) for one in (known, lost, other)] == ["/talker", "/talker", None]


def test_the_example_of_an_external_controller_answers_a_target(processes: Processes, node: Any, robot: Robot) -> None:
    example = processes.start(sys.executable, "examples/external_controller.py")
    targets = node.create_publisher(PoseStamped, "/cartesian_controller/safe_target/left", qos_profile_sensor_data)
    commands = subscribed(node, JointState, "/joint_commands")
    target = robot.tool_pose(robot.home, "left") * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.05]))
    while commands.empty() and example.running:
        targets.publish(stamped_pose(target, "world", 0.0))
        time.sleep(0.1)
    assert example.wait_for("mm away") == "target 50.0 mm away"
