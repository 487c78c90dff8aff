"""Both arms' nodes share one teleoperation. Killed or frozen nodes stop the arms, which only a press moves again."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes, as_arguments

need_ros()
pytestmark = pytest.mark.alone

from q2r2_control.errors import ConfigError
from q2r2_control.ros.nodes.arm_controllers import LeftArmController, RightArmController
from q2r2_control.types import Array
from tests.ros.arm_rig import offset
from tests.ros.cell import JointRecorder
from tests.ros.cockpit import ARMS, CONTROLLER, ROBOT, Cockpit
from tests.ros.processes import call, wait_until

MOVING = 0.2  # an arm that moves has a joint this fast [rad/s]
STILL = 0.005  # a joint that stands moves no farther [rad]
ANCHORED = 0.005  # a tool whose hand rests moves no farther [m]
FAST = 1.7  # hands turn the fastest joint at about 0.9: a jump to an old target would be faster [rad/s]
AWHILE = 0.5  # in which something would have moved if anything did [s]
WAY = (0.3, 0.0, 0.12)  # of the hands [m]
FROZEN = 2.0  # longer than any timeout [s]
HOME = 0.01  # [rad]
BINDINGS = {"teleop.bindings.grip": "home", "teleop.bindings.trigger": "carry"}


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cockpit:
    return Cockpit(module_node, robot, module_processes, BINDINGS | {"teleop.gate.timeout": 1.0, "rate": 100.0})


@pytest.fixture
def moving(started: Cockpit) -> Iterator[Cockpit]:
    """Both arms follow their hands from home, and go on to."""
    started.go_home()
    started.rigs.engage()
    mover = threading.Thread(target=started.rigs.move, args=(WAY, 1.2))
    mover.start()
    joints, arms = started.cell.joints, started.cell.robot.arms.values()
    wait_until(lambda: all(joints.speeds(0.05)[arm.joints].max() > MOVING for arm in arms), "both arms move")
    time.sleep(0.2)  # until they are fast
    yield started
    mover.join()


def stopped(moving: Cockpit, what: str, fault: float) -> JointRecorder:
    """Both arms have come to rest after a fault at that time [s], and have not jumped; tells how soon."""
    joints = moving.cell.joints
    speed, slow = joints.stop_after(fault)
    print(f"\n{what}: from {speed:.2f} rad/s slow within {1e3 * slow:.0f} ms")
    joints.wait_for_rest()
    assert joints.fastest(fault) < FAST
    return joints


def assert_only_a_press_moves(moving: Cockpit, joints: JointRecorder) -> None:
    """Nothing moves but by a press, which moves nothing itself: from then on the arms follow."""
    posture, began = joints.q, time.monotonic()
    time.sleep(AWHILE)
    moving.wait_until_up()
    moving.rigs.wait_until_ready(2)
    assert joints.farthest_from(posture, began) < STILL
    began = time.monotonic()
    moving.rigs.engage()
    time.sleep(AWHILE)
    assert joints.tool_farthest_from(posture, began) < ANCHORED  # elbows may move, towards their posture
    moving.rigs.move((0.0, 0.0, -0.06), 0.5)
    wait_until(lambda: joints.tool_farthest_from(posture, began) > 0.03, "the arms follow")
    assert joints.fastest(began) < FAST


@pytest.mark.parametrize("name", [ARMS, CONTROLLER])
def test_a_killed_node_stops_both_arms_and_its_restart_moves_none(name: str, moving: Cockpit) -> None:
    joints = stopped(moving, f"{name} killed", moving.signal(name, signal.SIGKILL))
    moving.restart(name)
    assert_only_a_press_moves(moving, joints)


@pytest.mark.parametrize("name", [ARMS, CONTROLLER])
def test_a_frozen_node_stops_both_arms_and_moves_none_when_it_continues(name: str, moving: Cockpit) -> None:
    fault = moving.signal(name, signal.SIGSTOP)
    joints = stopped(moving, f"{name} frozen", fault)
    time.sleep(max(fault + FROZEN - time.monotonic(), 0.0))
    moving.signal(name, signal.SIGCONT)
    moving.running[name].wait_for("stood still for")
    assert_only_a_press_moves(moving, joints)


def test_a_killed_robot_gets_no_old_command_when_it_is_restarted(moving: Cockpit) -> None:
    moving.signal(ROBOT, signal.SIGKILL)
    moving.running[CONTROLLER].wait_for("no joint states from /mujoco_robot for 0.")
    wait_until(lambda: moving.cell.state("phase") == "inactive", "the controller has braked")
    silence = time.monotonic()
    moving.restart(ROBOT)
    joints = moving.cell.joints
    wait_until(lambda: joints.since(silence), "the robot is back")
    back = joints.since(silence)[0]
    wait_until(lambda: moving.cell.state("phase") == "active", "the controller is active")
    time.sleep(AWHILE)
    assert joints.farthest_from(back.q, back.t) < STILL


def test_a_press_against_a_stopped_controller_engages_nothing_and_says_what_helps(moving: Cockpit) -> None:
    assert call(moving.cell.node, "/cartesian_controller/stop").success
    moving.rigs.wait_for_pause()
    cure = "/cartesian_controller is stopped: stopped by /cartesian_controller/stop; /cartesian_controller/reset"
    moving.rigs.wait(lambda rig: cure in rig.state["message"], "it says what helps")
    moving.rigs.press()
    time.sleep(AWHILE)
    assert not any(rig.state["engaged"] for rig in moving.rigs.rigs)
    assert call(moving.cell.node, "/cartesian_controller/reset").success
    moving.rigs.engage()


@pytest.fixture
def cockpit(started: Cockpit) -> Iterator[Cockpit]:
    started.go_away()
    yield started
    for arm in ("left", "right"):
        assert call(started.cell.node, f"/{arm}_q2r2_arm_controller/reset").success
    # The next press goes to arms that say they are not engaged, so an older state must not stand there.
    started.rigs.wait(lambda rig: not rig.state["engaged"], "both arms are reset")


def test_what_stops_one_arm_is_said_by_its_node_and_stops_the_linked_one(cockpit: Cockpit) -> None:
    left, right = cockpit.left, cockpit.right
    assert call(cockpit.cell.node, "/right_q2r2_arm_controller/pause").success
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "lost", "both arms are paused")
    assert left.state["last_event_kind"] == right.state["last_event_kind"] == "pause_service"
    cockpit.rigs.engage()
    left.hand = offset(left.hand, (1.0, 0.0, 0.0))
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "lost", "a jump of one hand pauses both")
    assert right.state["last_event_kind"] == "hand_jumped"


def test_an_arm_that_its_operator_pauses_stops_alone_and_the_other_goes_on(cockpit: Cockpit) -> None:
    left, right = cockpit.left, cockpit.right
    left.press()
    left.wait(lambda: left.state["state"] == "paused", "the left arm is paused")
    time.sleep(1.0)  # longer than the controller waits for targets
    assert right.state["engaged"]
    rest = cockpit.cell.q
    right.move((0.0, 0.0, 0.05), 0.5)
    joints = cockpit.cell.robot.arms
    wait_until(lambda: np.abs(cockpit.cell.q - rest)[joints["right"].joints].max() > 0.02, "the right arm follows")
    assert np.abs(cockpit.cell.q - rest)[joints["left"].joints].max() < STILL


def test_the_way_home_that_one_hand_asks_for_is_of_both_and_a_press_of_the_other_ends_it(cockpit: Cockpit) -> None:
    cockpit.left.grip = 1.0
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "homing", "both arms are on their way home")
    cockpit.left.grip = 0.0
    cockpit.right.press("upper")
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "both arms are paused")
    rest = cockpit.cell.joints.wait_for_rest()
    assert cockpit.from_home > 2.0 * HOME
    cockpit.rigs.wait(lambda rig: rig.state["ready"], "they can be engaged")
    assert call(cockpit.cell.node, "/cartesian_controller/home").success
    cockpit.rigs.wait(lambda rig: rig.state["last_event"] == "paused: at home", "a service brings both home")
    assert cockpit.from_home < HOME
    assert np.abs(cockpit.cell.q - rest).max() > HOME


def test_one_hand_moves_both_tools_which_keep_their_relation_and_needs_no_other_hand(cockpit: Cockpit) -> None:
    robot = cockpit.cell.robot
    cockpit.rigs.move((-0.06, 0.0, -0.05), 0.5)
    cockpit.cell.joints.wait_for_rest()
    cockpit.right.press()
    cockpit.right.sends_hand = False
    try:
        cockpit.left.trigger = 1.0
        cockpit.left.wait(lambda: cockpit.right.state["state"] == "carried", "the right arm is carried")
        cockpit.left.trigger = 0.0
        start = cockpit.cell.joints.wait_for_rest()
        cockpit.left.move((0.03, -0.03, -0.05), 1.5, 0.25)
        rest = cockpit.cell.joints.wait_for_rest()
        time.sleep(1.0)
        moved = robot.tool_pose(rest, "right").translation - robot.tool_pose(start, "right").translation
        assert np.linalg.norm(moved) > 0.03
        way, turn = apart(robot, start, cockpit.cell.q)
        assert way < 1e-3
        assert turn < np.radians(0.5)
    finally:
        cockpit.right.sends_hand = True
    cockpit.left.press()
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "a press ends it for both")


def apart(robot: Robot, start: Array, q: Array) -> tuple[float, float]:
    """By how much the relation of the tools differs from that at the start [m], [rad]."""
    wanted, found = (robot.tool_pose(at, "left").actInv(robot.tool_pose(at, "right")) for at in (start, q))
    turn = np.linalg.norm(pin.log3(found.rotation.T @ wanted.rotation))
    return float(np.linalg.norm(found.translation - wanted.translation)), float(turn)


@pytest.mark.parametrize("given", ["mirror:=true", "rate:=100.0", "teleop.linked:=false", "mode:=filtered"])
def test_nodes_that_cannot_be_one_teleoperation_are_refused(given: str, context: object) -> None:
    left = LeftArmController(context=context)
    with pytest.raises(ConfigError, match=f"{given.split(':')[0].split('.')[0]}.* differ; allowed: the same in both"):
        RightArmController(context=context, partner=left, cli_args=as_arguments(given))
    left.destroy_node()


def test_a_parameter_of_the_teleoperation_that_is_set_in_one_node_is_set_in_both(context: object) -> None:
    from rclpy.parameter import Parameter

    left = LeftArmController(context=context)
    right = RightArmController(context=context, partner=left)
    for name, value in (("mirror", True), ("teleop.leash.distance", 0.05)):
        assert right.set_parameters([Parameter(name, value=value)])[0].successful
        assert left.get_parameter(name).value == value
    assert left.parameters.teleop == right.parameters.teleop == left.loop.teleop.settings
    assert (left.hand, right.hand) == ("right", "left")
    for node in (right, left):
        node.destroy_node()


def test_a_wrong_parameter_of_one_arm_ends_both_in_one_line(processes: Processes) -> None:
    process = processes.start_node("arm_controllers", "right_q2r2_arm_controller:rate:=-1.0")
    assert process.wait() == 2
    line = process.output.splitlines()[-1]
    assert "parameter rate: " in line
    assert "allowed is 1 .. 1000" in line
