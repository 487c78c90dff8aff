"""Messages that nodes get from the middleware: late messages, joint states of single arms, torques, and refusals."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.teleop.reasons import TeleopReason
from tests.ros.conftest import need_ros

need_ros()

import rclpy
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray, String

from q2r2_control.ros import BaseArmController
from q2r2_control.ros.base_node import WARN, BaseNode
from q2r2_control.ros.bridge.arm_outputs import FollowWatch
from q2r2_control.ros.bridge.intakes import JointIntake, TargetIntake
from q2r2_control.ros.bridge.messages import pose_of, robot_state, stamped_pose
from q2r2_control.ros.nodes.arm_controllers import LeftArmController
from q2r2_control.ros.nodes.mujoco_robot import MujocoRobot
from q2r2_control.types import RobotState
from q2r2_control.wording import sentence
from tests.ros.processes import as_arguments, wait_until

USUAL, LATE = 1_000_000, 1_000_000_000  # Times from sending to receipt [ns].


class Arrivals:
    def __init__(self, node: Any, topic: str) -> None:
        self._subscription = next(one for one in node.subscriptions if one.topic_name == topic)
        self._number = 0

    def arrive(self, message: Any, took: int | None = None) -> None:
        """Deliver a message; ``took`` is its travel time [ns], for callbacks that examine it."""
        if took is None:
            self._subscription.callback(message)
            return
        self._number += 1
        received = 1_700_000_000_000_000_000 + self._number * 10_000_000
        times = {"source_timestamp": received - took, "received_timestamp": received}
        self._subscription.callback(message, {"publication_sequence_number": self._number, **times})


@pytest.fixture
def default_context(domain: int) -> Iterator[None]:
    rclpy.init(domain_id=domain)
    yield
    rclpy.try_shutdown()


def test_a_late_target_is_passed_on_as_none_and_reported(context: Any, robot: Robot) -> None:
    node = BaseNode("intake", context=context)
    intake = TargetIntake(node, robot, lambda: None)
    taken: list[bool] = []
    intake.subscribe(lambda arm, pose, *_: taken.append(pose is not None), lambda arm: None)
    targets = Arrivals(node, "/q2r2/left/target_frame")
    for took in (USUAL, USUAL, LATE, USUAL):
        targets.arrive(stamped_pose(pin.SE3.Identity(), "world", 0.0), took)
        if took == LATE:
            (refusal,) = intake.faults().values()
            assert (refusal.kind, refusal.detail["late"]) == (RosReason.TARGET_LATE, pytest.approx(1.0, abs=0.01))
    assert taken == [True, True, False, True]
    assert intake.rejected["left"] == 1
    assert intake.faults() == {}
    node.destroy_node()


def test_a_target_is_not_used_if_its_sender_stood_still_after_the_stamp_of_the_target(
    context: Any, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = BaseNode("intake", context=context)
    intake = TargetIntake(node, robot, lambda: None)
    taken: list[bool] = []
    intake.subscribe(lambda arm, pose, *_: taken.append(pose is not None), lambda arm: None)
    targets = Arrivals(node, "/q2r2/left/target_frame")
    stream = [(100.00, 99.0), (100.04, 99.01)]  # The second target is a little late.
    # One target is old, one is in time, and one is repeated.
    stream += [(102.05, 99.02), (102.06, 101.06), (105.0, 101.06)]
    stream += [(105.0 + 0.4 * tick, 102.0 + 0.1 * tick) for tick in range(1, 4)]  # The sender's clock is slow.
    for received, made in stream:
        monkeypatch.setattr(BaseNode, "now", received)
        targets.arrive(stamped_pose(pin.SE3.Identity(), "world", made), USUAL)
    assert taken == [True, True, False, *[True] * 5]
    node.destroy_node()


def test_a_target_that_is_not_used_is_reported_once_for_each_reason(context: Any, robot: Robot) -> None:
    node, reports = BaseNode("intake", context=context), []
    intake = TargetIntake(node, robot, lambda: reports.append(intake.faults()["left"]))
    away = Reason.of(SupervisionReason.STREAM_AWAY, distance=0.1, angle=0.0, engage_distance=0.03, engage_angle=0.3)
    intake.subscribe(lambda arm, pose, *_: None if pose is None else away, lambda arm: None)
    targets = Arrivals(node, "/q2r2/left/target_frame")
    for frame in ("elsewhere", "world"):
        for _ in range(5):
            targets.arrive(stamped_pose(pin.SE3.Identity(), frame, 0.0), USUAL)
    assert reports == [Reason.of(RosReason.TARGET_FRAME, frame="elsewhere", allowed="world"), away]
    assert intake.rejected["left"] == 10
    node.destroy_node()


def test_a_late_command_does_not_move_the_simulated_robot_and_is_reported(default_context: None, robot: Robot) -> None:
    node = MujocoRobot()
    commands = Arrivals(node, "/joint_commands")
    command = JointState(name=list(robot.joint_names), position=robot.home.tolist())
    for took in (USUAL, USUAL):
        commands.arrive(command, took)
    assert node.health()[2]["refused_commands"] == 0
    commands.arrive(command, LATE)
    level, line, values = node.health()
    assert (level, values["refused_commands"]) == (WARN, 1)
    assert line == "joint_commands: refused: 1.00 s late; its sender or this node stood still"
    commands.arrive(command, USUAL)
    assert node.health()[2]["refused_commands"] == 1
    node.close()
    node.destroy_node()


def test_joint_states_of_single_arms_are_merged_as_soon_as_all_joints_are_known(context: Any, robot: Robot) -> None:
    given = as_arguments(*(f"{arm}.joint_states_topic:=/{arm}/joint_states" for arm in robot.arms))
    node = BaseNode("intake", context=context, cli_args=given)
    intake = JointIntake(node, robot)
    taken: list[Any] = []
    intake.subscribe(lambda state, now: taken.append(state), lambda message: None)
    q = robot.home + 0.01 * np.arange(len(robot.home))

    def part(arm: str, without: str = "") -> None:
        joints = [(name, at) for name, at in zip(robot.joint_names, q, strict=True) if name.startswith(arm)]
        names, values = zip(*[joint for joint in reversed(joints) if joint[0] != without], strict=True)
        Arrivals(node, f"/{arm}/joint_states").arrive(JointState(name=list(names), position=list(values)))

    part("left")
    assert taken == []  # Nothing is known about the right arm yet.
    part("right")
    (state,) = taken
    assert isinstance(state, RobotState)
    np.testing.assert_allclose(state.q, q)
    part("right", without="right_A3")
    for _ in range(2):
        part("left")
    # The state is as old as the joint that was measured longest ago.
    assert taken[-2].stamp == taken[-1].stamp > state.stamp
    node.destroy_node()


def test_turns_of_endless_joints_are_counted_separately_for_each_arms_topic(
    context: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot.from_config(load_config("config/dual_kinova.yaml"))
    given = as_arguments(*(f"{arm}.joint_states_topic:=/{arm}/joint_states" for arm in robot.arms))
    node, clock = BaseNode("intake", context=context, cli_args=given), SimpleNamespace(now=100.0)
    monkeypatch.setattr(BaseNode, "now", property(lambda self: clock.now))
    intake = JointIntake(node, robot)
    taken: list[Any] = []
    intake.subscribe(lambda state, now: taken.append(state), lambda message: None)
    q, joint = robot.home.copy(), robot.joint_names.index("right_j2s6s200_joint_1")

    def report(arm: str, angle: float, after: float = 0.01) -> None:
        q[joint], clock.now = angle, clock.now + after
        joints = [(name, at) for name, at in zip(robot.joint_names, q, strict=True) if name.startswith(arm)]
        names, values = zip(*joints, strict=True)
        Arrivals(node, f"/{arm}/joint_states").arrive(JointState(name=list(names), position=list(values)))

    for arm in ("right", "left", "right"):
        report(arm, 6.0)  # The driver itself counts turns.
    assert taken[-1].q[joint] == 6.0, "what was not measured before says nothing about turns"
    report("right", 3.1, after=5.0)
    report("right", -3.1)
    assert taken[-1].q[joint] == pytest.approx(2.0 * np.pi - 3.1)
    report("right", 3.1, after=5.0)
    for _ in range(500):
        report("left", 3.1)
    report("right", -3.1)
    assert taken[-1].q[joint] == -3.1, "this topic was silent for 5 s, while the other one was not"
    node.destroy_node()


def test_states_of_several_publishers_on_one_topic_are_merged_by_joint_and_a_missing_joint_is_named(
    context: Any, robot: Robot
) -> None:
    node = BaseNode("intake", context=context)
    intake = JointIntake(node, robot)
    taken: list[Any] = []
    intake.subscribe(lambda state, now: taken.append(state), lambda message: None)
    names, q = list(robot.joint_names), robot.home + 0.01 * np.arange(len(robot.home))

    def send(first: int, end: int) -> None:
        message = JointState(name=["finger", *names[first:end]], position=[math.nan, *q[first:end]])
        Arrivals(node, "/joint_states").arrive(message)

    send(0, 5)
    assert taken == [Reason.of(RosReason.BAD_JOINT_STATES, text=f"no joint {names[5]} and 8 more")]
    send(5, 14)
    np.testing.assert_allclose(taken[-1].q, q)
    q += 0.1
    send(5, 14)
    np.testing.assert_allclose(taken[-1].q, [*(q[:5] - 0.1), *q[5:]])
    assert taken[-1].stamp == taken[-2].stamp  # The oldest part comes from the first publisher.
    send(0, 5)
    assert taken[-1].stamp > taken[-2].stamp
    node.destroy_node()


def test_joints_with_other_names_are_accepted_on_an_arms_own_topic_until_the_cells_names_come(
    context: Any, robot: Robot
) -> None:
    given = as_arguments("left.joint_states_topic:=/left/joint_states", "right.joint_states_topic:=joint_states")
    node = BaseNode("intake", context=context, cli_args=given)
    intake = JointIntake(node, robot)
    intake.subscribe(lambda state, now: None, lambda message: None)

    def send(topic: str, prefix: str, at: float) -> None:
        names = [f"{prefix}_A{number}" for number in range(1, 8)]
        Arrivals(node, topic).arrive(JointState(name=names, position=[at] * 7))

    left = robot.arms["left"].joints
    send("/joint_states", "right", 0.2)
    send("/left/joint_states", "lbr", 0.1)
    assert intake.state is not None
    np.testing.assert_allclose(intake.state.q[left], 0.1)
    assert intake.theirs["left_A3"] == "lbr_A3"
    for topic, prefix in (("/left/joint_states", "other"), ("/left/joint_states", "right"), ("/joint_states", "lbr")):
        send(topic, prefix, 0.3)  # These names belong to other robots.
        np.testing.assert_allclose(intake.state.q, np.where(np.isin(np.arange(14), left), 0.1, 0.2))
    send("/left/joint_states", "left", 0.4)
    np.testing.assert_allclose(intake.state.q[left], 0.4)
    assert intake.theirs == {}
    send("/left/joint_states", "lbr", 0.5)
    np.testing.assert_allclose(intake.state.q[left], 0.4)
    node.destroy_node()


def test_with_admittance_joint_states_are_used_only_if_external_torques_have_come(context: Any, robot: Robot) -> None:
    node = BaseNode("intake", context=context)
    with pytest.raises(ConfigError, match=r"admittance.enabled = true: set the parameter external_torque_topic"):
        JointIntake(node, robot, needs_external_torque=True)
    node.destroy_node()
    node = BaseNode("intake", context=context, cli_args=as_arguments("external_torque_topic:=/felt"))
    intake = JointIntake(node, robot, needs_external_torque=True)
    taken: list[Any] = []
    intake.subscribe(lambda state, now: taken.append(state), lambda message: None)
    names, torques = list(robot.joint_names), np.arange(len(robot.home), dtype=float)
    states, felt = Arrivals(node, "/joint_states"), Arrivals(node, "/felt")
    states.arrive(JointState(name=names, position=robot.home.tolist()))
    assert taken[-1] == Reason.of(RosReason.NO_EXTERNAL_TORQUES, topic="/felt")
    felt.arrive(JointState(name=names[::-1], effort=torques[::-1].tolist()))
    states.arrive(JointState(name=names, position=robot.home.tolist()))
    assert isinstance(taken[-1], RobotState)
    np.testing.assert_array_equal(taken[-1].tau_external, torques)
    felt.arrive(JointState(name=names, effort=[math.nan] * len(names)))
    states.arrive(JointState(name=names, position=robot.home.tolist()))
    assert isinstance(taken[-1], RobotState)
    np.testing.assert_array_equal(taken[-1].tau_external, torques)
    node.destroy_node()


def test_an_arm_pauses_when_its_controller_does_not_follow_except_during_homing(context: Any) -> None:
    node = BaseNode("arm", context=context)
    watch = FollowWatch(node, "/controller", "left", 0.3)
    node.create_publisher(String, "/controller/state", 1)
    following, states = Arrivals(node, "/controller/following/left"), Arrivals(node, "/controller/state")
    topic = "/controller/following/left"
    assert watch.refusal(True, 0.0) is None
    assert watch.refusal(True, 9.0) == Reason.of(RosReason.NOT_FOLLOWED, topic=topic), "one that says nothing"
    following.arrive(Bool(data=False))
    assert watch.refusal(False, 10.0) is None
    assert watch.refusal(True, 10.1) is None
    assert watch.refusal(True, 10.5) == Reason.of(RosReason.NOT_FOLLOWED, topic=topic)
    following.arrive(Bool(data=True))
    assert watch.refusal(True, 11.0) is None
    assert watch.refusal(True, 11.5) is None
    following.arrive(Bool(data=False))
    assert watch.refusal(True, 11.6) == Reason.of(RosReason.FOLLOWED_NO_MORE, topic=topic)
    states.arrive(String(data=controller_state("homing", None)))
    for text in ("no JSON", "[]", "{}"):
        states.arrive(String(data=text))
    assert (watch.homing, watch.unready, watch.refusal(True, 20.0)) == (True, None, None)
    node.destroy_node()


def controller_state(arm: str, fault: Reason | None, outcome: Reason | None = None) -> str:
    said = {"fault": fault, "homing_outcome": outcome}
    return json.dumps({"left_state": arm} | {key: why and why.as_json() for key, why in said.items()})


@pytest.mark.parametrize(
    ("arm", "fault", "unready"),
    [
        # A following arm counts as ready, even if its controller reports a fault.
        ("following", Reason(RosReason.STOP_SERVICE), None),
        ("paused", None, "controller_on_pause"),
        ("inactive", None, "controller_phase"),
        ("inactive", Reason(TeleopReason.CLOCK_NOT_FINITE), "controller_fault"),
        ("stopped", Reason(RosReason.STOP_SERVICE), "controller_stopped"),
        ("deactivated", Reason.of(RosReason.CONTROLLER_DEACTIVATED, controller="/c"), "controller_deactivated"),
    ],
)
def test_the_reason_why_a_controller_does_not_follow_is_read_from_its_state(
    arm: str, fault: Reason | None, unready: str | None, context: Any
) -> None:
    node = BaseNode("arm", context=context)
    node.create_publisher(String, "/c/state", 1)
    watch = FollowWatch(node, "/c", "left", 0.3)
    Arrivals(node, "/c/state").arrive(String(data=controller_state(arm, fault)))
    assert (watch.unready and str(watch.unready.kind)) == unready
    assert watch.unready is None or watch.unready.root == (fault or watch.unready)
    # `sentence` must not raise: the reason has a value for each placeholder.
    assert watch.unready is None or sentence(watch.unready)
    node.destroy_node()


def test_an_arm_is_not_ready_before_a_new_controller_has_reported_that_it_gets_joint_states(context: Any) -> None:
    arm = LeftArmController(context=context)
    states = Arrivals(arm, "/cartesian_controller/state")

    def obstacle() -> ReasonKind | None:
        arm.outputs.take_fault(arm.now)
        return None if (unready := arm.outputs.unready) is None else unready.root.kind

    for _ in range(2):
        wait_until(lambda: obstacle() is RosReason.NO_SUBSCRIBER, "no controller is there")
        controller = BaseNode("cartesian_controller", context=context)
        controller.create_subscription(PoseStamped, arm.outputs.first.topic, lambda message: None, 1)
        wait_until(lambda: obstacle() is RosReason.TOPIC_EMPTY, "a controller is there that has not reported")
        no_states = Reason.of(SupervisionReason.NO_STATES_YET, source="")
        for said, kind in ((("inactive", no_states), SupervisionReason.NO_STATES_YET), (("holding", None), None)):
            states.arrive(String(data=controller_state(*said)))
            assert obstacle() is kind
        controller.destroy_node()
    arm.destroy_node()


def test_a_subclass_without_a_preset_is_not_ready_unless_the_built_in_controller_runs(context: Any) -> None:
    """Another project's controller would get targets with steps as large as the built-in controller's limits allow."""
    prefix = "/bh_robot/left_arm_clik_controller"
    arm = BaseArmController("left", "bh_robot", ctrl_prefix=prefix, context=context)
    theirs = BaseNode("left_arm_clik_controller", namespace="/bh_robot", context=context)
    theirs.create_subscription(PoseStamped, f"{prefix}/target_frame", lambda message: None, 1)

    def unready() -> Reason | None:
        arm.outputs.take_fault(arm.now)
        return arm.outputs.unready

    wait_until(lambda: (why := unready()) and why.root.kind is not RosReason.NO_SUBSCRIBER, "it has a subscriber")
    absent = unready()
    assert absent is not None
    assert absent.root.kind is RosReason.CONTROLLER_ABSENT
    assert "nobody publishes /cartesian_controller/state (std_msgs/msg/String)" in sentence(absent)
    controller = BaseNode("cartesian_controller", context=context)
    wait_until(lambda: (why := unready()) and why.root.kind is RosReason.TOPIC_EMPTY, "the built-in controller begins")
    Arrivals(arm, "/cartesian_controller/state").arrive(String(data=controller_state("holding", None)))
    assert unready() is None
    controller.destroy_node()
    wait_until(lambda: (why := unready()) and why.root.kind is RosReason.CONTROLLER_ABSENT, "it has ended")
    for node in (theirs, arm):
        node.destroy_node()


def test_an_unreadable_message_is_dropped_with_one_warning_for_each_topic(
    context: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    arm, name, text = LeftArmController(context=context), "/cartesian_controller", String(data="[]")
    bad: dict[str, Any] = {f"{name}/state": text, f"{name}/condition/left": text, "/recorder/state": text}
    bad |= {"/tf_static": b"no message", f"{name}/opening/left": Float64MultiArray(data=[2.0, 1.0])}
    for topic in [*bad, *bad]:
        Arrivals(arm, topic).arrive(bad[topic])
    lines = [line for line in capfd.readouterr().err.splitlines() if "cannot be read" in line]
    assert len(lines) == len(bad)
    assert all("[WARN]" in line and f" {topic}: " in line for line, topic in zip(lines, bad, strict=True))
    arm.destroy_node()


NAMES = ("a", "b", "c")
TURN = {"z": 0.6, "w": 0.8}


def joint_state(**changes: Any) -> JointState:
    fields = {
        "name": ["c", "finger", "a", "b"],
        "position": [3.0, math.nan, 1.0, 2.0],
        "velocity": [0.3, 0.9, 0.1, 0.2],
    }
    return JointState(**(fields | changes))


def test_a_joint_state_is_read_by_name_even_if_other_joints_are_not_finite_or_torques_are_missing() -> None:
    state = robot_state(joint_state(), NAMES, 7.0)
    assert isinstance(state, RobotState)
    assert (state.q.tolist(), state.v.tolist(), state.tau.tolist()) == ([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], [0.0] * 3)
    assert state.stamp == 7.0


def test_velocities_and_torques_that_are_not_measured_are_read_as_zero() -> None:
    unmeasured = [math.nan] * 4
    state = robot_state(joint_state(velocity=unmeasured, effort=[1.0, math.nan, math.nan, 2.0]), NAMES, 7.0)
    assert isinstance(state, RobotState)
    assert (state.v.tolist(), state.tau.tolist()) == ([0.0] * 3, [0.0, 2.0, 1.0])


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"name": ["c", "finger", "b", "b"]}, "a joint is named twice"),
        ({"name": ["c", "finger", "other", "b"]}, "no joint a"),
        ({"position": [3.0, 9.0, math.nan, 2.0]}, "position of a is not finite"),
        ({"velocity": [math.inf, 0.9, 0.1, 0.2]}, "velocity of c is not finite"),
        ({"velocity": [math.nan, 0.9, 0.1, 0.2]}, "velocity of c is not finite"),
        ({"effort": [0.1, 0.9, math.inf, 0.2]}, "effort of a is not finite"),
        ({"position": [3.0, 9.0, 1.0]}, "3 position values for 4 joints"),
        ({"position": []}, "0 position values for 4 joints"),
    ],
)
def test_the_reason_for_an_invalid_joint_state_says_what_is_wrong(changes: dict[str, Any], fault: str) -> None:
    assert robot_state(joint_state(**changes), NAMES, 0.0) == fault


def test_a_pose_is_read_with_its_quaternion_normalized() -> None:
    pose = pose_of(Pose(position=Point(x=1.0), orientation=Quaternion(z=0.6003, w=0.8004)))
    assert pose is not None
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("position", "orientation"),
    [({"x": math.nan}, TURN), ({"y": math.inf}, TURN), ({}, {"w": 0.0}), ({}, {"w": 1.1}), ({}, {"w": math.nan})],
)
def test_a_pose_message_with_invalid_numbers_is_read_as_none(
    position: dict[str, float], orientation: dict[str, float]
) -> None:
    assert pose_of(Pose(position=Point(**position), orientation=Quaternion(**orientation))) is None
