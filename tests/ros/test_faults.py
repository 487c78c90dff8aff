"""Nodes are killed or frozen while both arms move: the arms stop, and only a press moves them again."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes
from tests.ros.waiting import call, wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from q2r2_control.types import SIDES  # noqa: E402
from tests.ros.teleoperation import AWHILE, ENDPOINT, NAMES, STILL, Record, Teleoperation  # noqa: E402

# The node that is frozen for a while, and what it says itself when it goes on.
FROZEN = {"arm_controllers": "this node stood still for", "cartesian_controller": "the control loop stood still for"}
CONTROLLER = "/cartesian_controller"


@pytest.fixture(scope="module")
def teleop(
    domain: int, robot: Robot, interfaces: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Teleoperation]:
    """All nodes and a connected headset."""
    processes = Processes(tmp_path_factory.mktemp("faults"), os.environ)
    with spun_node(domain) as node:
        try:
            running = Teleoperation(node, robot, processes)
            with running.connected():
                yield running
        finally:
            processes.end_all()


@pytest.fixture
def moving(teleop: Teleoperation) -> Teleoperation:
    """Both arms follow their hands, whatever state an earlier test has left."""
    for name in NAMES:
        teleop.restore(name)
    teleop.move()
    return teleop


@pytest.mark.parametrize("name", [ENDPOINT, "arm_controllers", "cartesian_controller"])
def test_a_killed_node_stops_both_arms_and_its_restart_moves_none(
    name: str, moving: Teleoperation, record_property: Record
) -> None:
    fault = moving.kill(name)
    if name == ENDPOINT:  # arms follow a hand that stands still until its data are missed
        wait_until(lambda: not any(map(moving.engaged, SIDES)), "both arms are paused")
    stop = moving.measure_stop(f"{name} killed", fault, record_property)
    moving.restore(name)
    moving.assert_only_a_press_moves(stop)


@pytest.mark.parametrize("name", FROZEN)
def test_a_frozen_node_stops_both_arms_and_moves_none_when_it_continues(
    name: str, moving: Teleoperation, record_property: Record
) -> None:
    fault = moving.signal(name, signal.SIGSTOP)
    stop = moving.measure_stop(f"{name} frozen", fault, record_property)
    time.sleep(max(fault + 2.0 - time.monotonic(), 0.0))
    woken = moving.signal(name, signal.SIGCONT)
    moving.wait_for_diagnosis(woken, FROZEN[name])
    moving.assert_only_a_press_moves(stop)


def test_a_killed_robot_is_reported_and_gets_no_old_command_when_it_is_restarted(moving: Teleoperation) -> None:
    fault = moving.kill("mujoco_robot")
    moving.wait_for_diagnosis(fault, "no joint states from /mujoco_robot for 0.")
    wait_until(lambda: moving.controller_is("inactive", fault), "the controller has braked")
    time.sleep(0.1)
    silence = time.monotonic()
    moving.restore("mujoco_robot")
    wait_until(lambda: moving.joints.since(silence), "the robot is back")
    back = moving.joints.since(silence)[0]
    wait_until(lambda: moving.controller_is("active", back.t), "the controller is active")
    time.sleep(AWHILE)
    # The controller may have found the robot before this test did; whatever it commands, it is where the robot stands.
    commands = [np.abs(q - back.q).max() for t, q in moving.commands if t > silence]
    assert commands, "the controller holds the arms where they are"
    assert max(commands) < STILL
    assert moving.joints.farthest_from(back.q, back.t) < STILL


def test_a_press_against_a_stopped_controller_engages_nothing_and_says_what_helps(moving: Teleoperation) -> None:
    since = time.monotonic()
    assert call(moving.node, f"{CONTROLLER}/stop").success
    moving.wait_for_diagnosis(since, f"{CONTROLLER} is stopped: stopped by {CONTROLLER}/stop; {CONTROLLER}/reset")
    wait_until(lambda: not any(map(moving.engaged, SIDES)), "both arms are paused")
    moving.operator.rest()
    moving.operator.press(*SIDES)
    time.sleep(AWHILE)
    assert not any(map(moving.engaged, SIDES))
    assert call(moving.node, f"{CONTROLLER}/reset").success
    moving.move()
