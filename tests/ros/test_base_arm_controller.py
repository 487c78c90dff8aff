"""The teleoperation node of an arm as a process: topics, actions, services, state."""

from __future__ import annotations

import os
import signal
import threading
import time
from queue import Queue
from typing import Any

import numpy as np
import pytest

from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import PATIENCE, Processes, as_arguments, call

need_ros()

import control_msgs.action
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSInputs
from rclpy.action import ActionServer
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from q2r2_control.errors import ConfigError
from q2r2_control.ros.bridge.messages import time_message
from q2r2_control.ros.nodes.arm_controllers import LeftArmController
from q2r2_control.ros.reasons import RosReason
from q2r2_control.teleop.haptics import GRASP, NEAR
from tests.ros.arm_rig import TOOL, ArmRig, assert_same, offset, patient, steps, target_of
from tests.ros.programs.stalling_arm import STALL


def test_an_arm_engages_at_its_tool_follows_the_hand_and_resumes_after_a_pause_without_a_jump(
    rig: ArmRig, processes: Processes
) -> None:
    process = rig.start(processes)
    rig.move((0.2, 0.0, 0.0), 0.1)
    time.sleep(0.3)
    assert rig.targets == []
    rig.engage()
    rig.wait(lambda: rig.targets, "the first target comes")
    assert_same(target_of(rig), TOOL, 1e-9)
    assert rig.targets[0].header.frame_id == "world"

    rig.move((0.05, -0.1, 0.08), turn=0.3)
    assert_same(rig.wait_for_rest(), offset(TOOL, (0.05, -0.1, 0.08), 0.3), 1e-3)
    rig.pause()
    held = rig.wait_for_rest()
    rig.move((-0.3, 0.3, -0.2), turn=-0.8)
    rig.let_the_hand_rest()
    assert_same(rig.newest(), held, 1e-12)
    rig.engage()
    before = len(rig.targets)
    rig.wait(lambda: len(rig.targets) > before + 5, "targets come again")
    rig.move((0.0, 0.05, 0.0))
    assert_same(rig.wait_for_rest(), offset(held, (0.0, 0.05, 0.0)), 1e-3)

    assert max(steps(rig.targets)) < 0.02
    assert all(abs(np.linalg.norm(_quaternion(target)) - 1.0) < 1e-12 for target in rig.targets)
    assert (0.0, 0.0) in rig.pulses
    assert len(rig.pulses) >= 6  # Two engagements and a pause were felt: three pulses and their ends.
    assert process.interrupt() == 0


def _quaternion(target: Any) -> list[float]:
    orientation = target.pose.orientation
    return [orientation.x, orientation.y, orientation.z, orientation.w]


def test_an_arm_that_hangs_below_its_target_resumes_with_this_target_after_a_pause(
    rig: ArmRig, processes: Processes
) -> None:
    """Another controller moves the arm and reports no command. Its last target counts as the pose that it holds."""
    rig.start(processes)
    rig.engage()
    rig.wait(lambda: rig.targets, "targets come")
    rig.follows = False
    rig.tool = offset(TOOL, (0.0, 0.0, -0.02))
    for _ in range(2):
        rig.pause()
        rig.engage()
        rig.targets.clear()
        rig.wait(lambda: len(rig.targets) > 5, "targets come again")
        assert_same(rig.newest(), TOOL, 1e-5)
    rig.move((0.0, 0.05, 0.0))
    assert_same(rig.wait_for_rest(), offset(TOOL, (0.0, 0.05, 0.0)), 1e-3)


def test_a_silent_hand_pauses_its_arm_and_the_return_of_hand_data_moves_no_arm(
    rig: ArmRig, processes: Processes
) -> None:
    rig.start(processes, {"teleop.gate.timeout": 0.5})
    rig.engage()
    rig.move((0.1, 0.0, 0.0), 0.2)
    rig.sends_hand = False
    rig.wait(lambda: rig.state["state"] == "lost", "the watchdog pauses the arm")
    assert rig.state["last_event_kind"] == RosReason.HAND_SILENT
    assert "/test" in rig.state["last_event"]
    rig.wait(lambda: rig.state.get("kind") == RosReason.HAND_SILENT, "diagnostics say so")
    assert "/test" in rig.state["message"]
    assert rig.state["level"] == "warn"
    held = rig.wait_for_rest()
    rig.hand = offset(rig.hand, (0.3, 0.3, 0.0))
    rig.sends_hand = True
    time.sleep(0.5)
    assert rig.state["state"] == "lost"
    assert_same(rig.newest(), held, 1e-12)
    rig.engage()
    rig.wait_for_rest()
    assert_same(rig.newest(), held, 1e-6)


def test_a_node_that_stood_still_during_a_tick_sends_no_target_from_before_the_standstill(
    rig: ArmRig, processes: Processes
) -> None:
    """The node sends neither the target that it had computed, nor the rest of its last motion."""
    process = processes.start_module("tests.ros.programs.stalling_arm", *as_arguments(*patient({})))
    rig.wait_until_connected()
    rig.engage()
    mover = threading.Thread(target=rig.move, args=((0.6, 0.0, 0.0), 2.0))
    mover.start()
    time.sleep(0.5)
    os.kill(process.pid, signal.SIGUSR1)
    time.sleep(0.5 * STALL)
    before, held = len(rig.targets), rig.newest()
    assert held.translation[0] > TOOL.translation[0] + 0.05  # The arm was moving.
    rig.wait(lambda: rig.state["last_event_kind"] == RosReason.NODE_STALLED, "it has gone on")
    assert rig.state["paused_kind"] == RosReason.NODE_STALLED
    mover.join()
    assert len(rig.targets) == before
    rig.engage()
    rig.move((0.0, 0.05, 0.0))
    assert_same(rig.wait_for_rest(), offset(held, (0.0, 0.05, 0.0)), 1e-3)


def test_an_arm_needs_the_pose_of_its_tool_and_a_gripper_needs_its_server(rig: ArmRig, processes: Processes) -> None:
    rig.sends_tool = False
    rig.start(processes)
    rig.press()
    rig.wait(lambda: rig.state["last_event_kind"] == RosReason.NO_TRANSFORM, "the press is refused")
    assert (rig.state["level"], rig.state["kind"]) == ("warn", RosReason.NO_TOOL_POSE)
    assert "left_tool_frame" in rig.state["message"]
    rig.sends_tool = True
    rig.engage()
    rig.wait(lambda: rig.targets, "targets come")
    rig.sends_tool = False
    rig.wait(lambda: rig.state["state"] == "lost", "an arm whose tool is not seen any more is paused")
    assert rig.state["last_event_kind"] == RosReason.TRANSFORM_OLD
    assert "/test" in rig.state["last_event"]

    rig.sends_tool = True
    rig.press("upper")
    rig.wait(lambda: rig.state.get("kind") == RosReason.GRIPPER_FAILED, "it is reported")
    assert "/q2r2/left_gripper/gripper_cmd" in rig.state["message"]
    assert rig.state["gripper"] == "open"


def test_the_services_pause_and_reset_pause_the_arm_and_a_second_publisher_of_targets_pauses_it_too(
    rig: ArmRig, node: Any, processes: Processes
) -> None:
    rig.start(processes)
    for service in ("pause", "reset"):
        rig.engage()
        assert call(node, f"/left_q2r2_arm_controller/{service}").success
        rig.wait(lambda: rig.state["state"] == "lost", "the service pauses the arm")

    rig.engage()
    second = node.create_publisher(PoseStamped, "/q2r2/left/target_frame", 1)
    rig.wait(lambda: rig.state["level"] == "error", "the second publisher is reported")
    assert rig.state["kind"] == RosReason.SEVERAL_PUBLISHERS
    assert "/q2r2/left/target_frame" in rig.state["message"]
    assert rig.state["state"] == "lost"
    rig.press()
    assert rig.state["state"] == "lost"
    node.destroy_publisher(second)
    rig.engage()


@pytest.mark.parametrize("topic", ["q2r_left_hand_pose", "q2r_left_hand_inputs"])
def test_a_second_publisher_of_the_same_hand_pauses_the_arm_and_is_named(
    topic: str, rig: ArmRig, domain: int, processes: Processes
) -> None:
    rig.start(processes)
    rig.engage()
    with spun_node(domain, "another_headset") as other:
        other.create_publisher(PoseStamped if topic.endswith("pose") else OVR2ROSInputs, topic, 1)
        rig.wait(lambda: rig.state.get("kind") == RosReason.SEVERAL_PUBLISHERS, "the second publisher is reported")
        assert rig.state["level"] == "error"
        rig.wait(lambda: f"/{topic} (/another_headset and /test)" in rig.state["message"], "both are named")
        assert rig.state["state"] == "lost"
        rig.press()
        assert rig.state["state"] == "lost"
    rig.engage()


def test_a_hand_feels_the_small_spare_distance_of_its_arm_that_the_controller_reports(
    rig: ArmRig, node: Any, processes: Processes
) -> None:
    publisher = node.create_publisher(String, "/cartesian_controller/condition/left", 10)
    rig.start(processes)
    rig.wait(publisher.get_subscription_count, "the node listens")
    for data in ("no JSON", '{"spare_distance": "near"}', "{}", '{"spare_distance": 0.0}'):
        publisher.publish(String(data=data))
    rig.wait(lambda: len(rig.pulses) >= 2, "a vibration comes, and its end")
    assert rig.pulses == [(NEAR.frequency, 0.6), (0.0, 0.0)]


@pytest.mark.parametrize("kind", ["GripperCommand", "ParallelGripperCommand"])
def test_a_gripper_counts_as_closed_when_the_result_of_its_goal_says_stalled(
    kind: str, rig: ArmRig, processes: Processes, domain: int
) -> None:
    action = getattr(control_msgs.action, kind)
    goals: Queue[Any] = Queue()
    stalls = True

    def execute(goal: Any) -> Any:
        goals.put(goal.request.command)
        goal.abort()  # Real grippers abort a goal if an object stops their fingers.
        return action.Result(stalled=stalls)

    with spun_node(domain, "gripper") as other:
        ActionServer(other, action, "/q2r2/left_gripper/gripper_cmd", execute)
        joint = {"gripper.joint_name": "finger"} if kind == "ParallelGripperCommand" else {}
        rig.start(processes, {"gripper.action_type": kind, "gripper.open_position": 0.04, **joint})
        while goals.empty():  # A press has no effect before the server is discovered.
            rig.press("upper")
            rig.wait(lambda: not goals.empty() or "kind" in rig.state, "an answer to the press")
        command = goals.get()
        assert (command.position[0] if joint else command.position) == 0.05
        assert not joint or list(command.name) == ["finger"]
        rig.wait(lambda: rig.state["gripper"] == "closed", "stalled is closed")
        rig.wait(lambda: GRASP[:2] in rig.pulses, "the hand feels what the gripper has closed on")
        stalls = False
        rig.press("upper")
        command = goals.get(timeout=PATIENCE)
        assert (command.position[0] if joint else command.position) == 0.04
        rig.wait(lambda: rig.state.get("kind") == RosReason.GRIPPER_FAILED, "the failure is reported")
        assert rig.state["gripper"] == "closed"


BAD_PARAMETERS = {
    "preset:=kuka": "preset = 'kuka': allowed are builtin, kuka_lbr_clik",
    "preset:=jtc": "preset = 'jtc' with mode = 'raw': it takes joint positions",
    "mirror_reflected:=true": "allowed with mirror = True only",
    "rate:=5.0": "parameter rate = 5: preset builtin needs at least 20",
    "teleop.bindings.grip:=dead_man": "lower is pause_toggle and grip is dead_man; allowed: one way to engage",
}


@pytest.mark.parametrize("given", BAD_PARAMETERS)
def test_a_bad_parameter_raises_an_error_of_one_line(given: str, context: Any) -> None:
    with pytest.raises(ConfigError) as error:
        LeftArmController(context=context, cli_args=as_arguments(given))
    assert BAD_PARAMETERS[given] in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_without_a_running_clock_an_arm_is_neither_engaged_nor_ready(
    rig: ArmRig, node: Any, processes: Processes
) -> None:
    diagnostics: list[DiagnosticStatus] = []
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: diagnostics.extend(message.status), 10)
    rig.start(processes, {"use_sim_time": True})
    rig.wait(lambda: rig.state.get("clock_problem") == {"kind": RosReason.NO_CLOCK}, "it says so")
    rig.wait(lambda: diagnostics and "clock_problem" in {one.key for one in diagnostics[-1].values}, "diagnostics too")
    assert (diagnostics[-1].name, diagnostics[-1].level) == ("/left_q2r2_arm_controller", DiagnosticStatus.ERROR)
    rig.press()
    assert (rig.state["engaged"], rig.state["ready"], rig.targets) == (False, False, [])

    publisher, began = node.create_publisher(Clock, "/clock", 1), time.monotonic()
    send_time = lambda: publisher.publish(Clock(clock=time_message(1.0 + time.monotonic() - began)))  # noqa: E731
    timer = node.create_timer(0.01, send_time)
    rig.wait(lambda: rig.state["ready"], "it is ready when time comes")
    assert (rig.state["engaged"], rig.targets) == (False, [])  # The earlier press has not engaged the arm.
    rig.engage()
    node.destroy_timer(timer)
    # On a machine with other load, another fault may have paused the arm already. The test therefore reads the problem
    # of the clock, and not the reason for the pause.
    rig.wait(lambda: rig.state.get("clock_problem") == {"kind": RosReason.CLOCK_STANDS}, "it says that time stops")
    rig.wait(lambda: not rig.state["engaged"] and not rig.state["ready"], "it is paused")
    rig.press()
    node.create_timer(0.01, send_time)
    rig.wait(lambda: rig.state["ready"], "it is ready when time goes on")
    assert not rig.state["engaged"]
