"""If a node is killed or frozen, both arms stop. Only a press lets them move again."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from q2r2_control import Robot
from q2r2_control.ros.reasons import RosReason
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()
pytestmark = pytest.mark.alone


from tests.ros.cell import JointRecorder
from tests.ros.cockpit import ARMS, CONTROLLER, Cockpit
from tests.ros.processes import wait_until

MOVING = 0.2  # A moving arm has a joint with at least this speed [rad/s].
STILL = 0.005  # A resting joint moves less than this [rad].
ANCHORED = 0.005  # A tool whose hand rests moves less than this [m].
# Hands turn the fastest joint at about 0.9 rad/s. A jump to an old target would be faster than this [rad/s].
FAST = 1.7
AWHILE = 0.5  # Time in which any motion would be seen [s].
WAY = (0.3, 0.0, 0.12)  # Motion of the hands [m].
FROZEN = 2.0  # Duration of a freeze, which is longer than any timeout [s].


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cockpit:
    return Cockpit(module_node, robot, module_processes, {"teleop.gate.timeout": 1.0, "rate": 100.0})


@pytest.fixture
def moving(started: Cockpit) -> Iterator[Cockpit]:
    """Let both arms follow their hands from home during the test."""
    started.go_home()
    started.rigs.engage()
    mover = threading.Thread(target=started.rigs.move, args=(WAY, 1.2))
    mover.start()
    joints, arms = started.cell.joints, started.cell.robot.arms.values()
    wait_until(lambda: all(joints.speeds(0.05)[arm.joints].max() > MOVING for arm in arms), "both arms move")
    time.sleep(0.2)  # The arms become fast in this time.
    yield started
    mover.join()


def stopped(moving: Cockpit, what: str, fault: float) -> JointRecorder:
    """Assert that both arms come to rest without a jump after a fault, and print how soon.

    ``fault`` is the time of the fault [s]. Return the recorder of the joints.
    """
    joints = moving.cell.joints
    speed, slow = joints.stop_after(fault)
    print(f"\n{what}: from {speed:.2f} rad/s slow within {1e3 * slow:.0f} ms")
    joints.wait_for_rest()
    assert joints.fastest(fault) < FAST
    return joints


def assert_only_a_press_moves(moving: Cockpit, joints: JointRecorder) -> None:
    """Assert that the arms rest before a press, that no tool moves at the press, and that the arms then follow."""
    posture, began = joints.q, time.monotonic()
    time.sleep(AWHILE)
    moving.wait_until_up()
    moving.rigs.wait_until_ready(2)
    assert joints.farthest_from(posture, began) < STILL
    began = time.monotonic()
    moving.rigs.engage()
    time.sleep(AWHILE)
    assert joints.tool_farthest_from(posture, began) < ANCHORED  # Elbows may move towards their posture.
    moving.rigs.move((0.0, 0.0, -0.06), 0.5)
    wait_until(lambda: joints.tool_farthest_from(posture, began) > 0.03, "the arms follow")
    assert joints.fastest(began) < FAST


def test_a_killed_node_stops_both_arms_and_its_restart_moves_no_arm(moving: Cockpit) -> None:
    joints = stopped(moving, "controller killed", moving.signal(CONTROLLER, signal.SIGKILL))
    moving.restart(CONTROLLER)
    assert_only_a_press_moves(moving, joints)


def test_a_frozen_node_stops_both_arms_and_moves_no_arm_when_it_continues(moving: Cockpit) -> None:
    fault = moving.signal(ARMS, signal.SIGSTOP)
    joints = stopped(moving, "arms frozen", fault)
    time.sleep(max(fault + FROZEN - time.monotonic(), 0.0))
    moving.signal(ARMS, signal.SIGCONT)
    moving.rigs.wait(lambda rig: rig.state["last_event_kind"] == RosReason.NODE_STALLED, "the pause is reported")
    assert_only_a_press_moves(moving, joints)


def test_a_wrong_parameter_of_one_arm_ends_the_process_of_both_arms_with_one_line(processes: Processes) -> None:
    process = processes.start_node("arm_controllers", "right_q2r2_arm_controller:rate:=-1.0")
    assert process.wait() == 2
    line = process.output.splitlines()[-1]
    assert "parameter rate: " in line
    assert "allowed is 1 .. 1000" in line
