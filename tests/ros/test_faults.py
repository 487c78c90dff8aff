"""Nodes are killed or frozen while both arms move: the arms stop, and only a press moves them again."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from q2r2_control import Robot
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()
pytestmark = pytest.mark.alone

from tests.ros.cockpit import ARMS, CONTROLLER, ROBOT, Cockpit
from tests.ros.joint_recorder import JointRecorder
from tests.ros.waiting import call, wait_until

MOVING = 0.2  # an arm that moves has a joint this fast [rad/s]
STILL = 0.005  # a joint that stands moves no farther [rad]
ANCHORED = 0.005  # a tool whose hand rests moves no farther [m]
FAST = 1.7  # hands turn the fastest joint at about 0.9: a jump to an old target would be faster [rad/s]
AWHILE = 0.5  # in which something would have moved if anything did [s]
WAY = (0.3, 0.0, 0.12)  # of the hands [m]
FROZEN = 2.0  # longer than any timeout [s]


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cockpit:
    return Cockpit(module_node, robot, module_processes, {"teleop.gate.timeout": 1.0, "rate": 100.0})


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
    stop = joints.stop_after(fault)
    print(f"\n{what}: from {stop.speed:.2f} rad/s slow within {1e3 * stop.slow:.0f} ms")
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
