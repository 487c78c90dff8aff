"""Each node is killed or frozen while both arms move: the arms stop, and only a press moves them again.

Times are those of joint states received here, on the machine's steady clock.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes, skip_if_overloaded
from tests.ros.waiting import call, wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from tests.ros.teleop_nodes import ARMS, TeleopNodes  # noqa: E402
from tests.ros.teleoperation import (  # noqa: E402
    AWHILE,
    ENDPOINT,
    FAST,
    STILL,
    Record,
    Teleoperation,
    teleoperation,
)

NODES = ("mujoco_robot", "cartesian_controller", "left_arm_controller", "right_arm_controller", ENDPOINT)
# The node that is killed, and what /diagnostics say then.
KILLED = {
    "tcp_endpoint": "of the left hand from /tcp_endpoint for 0.",
    "left_arm_controller": "linked to left: /left_q2r2_arm_controller is silent for 0.",
    "right_arm_controller": "linked to right: /right_q2r2_arm_controller is silent for 0.",
    "cartesian_controller": "/cartesian_controller",  # is silent, or acknowledges no targets
}
# The node that is frozen for a while, and what it says itself when it goes on.
FROZEN = {
    "left_arm_controller": "this node stood still for 1.",
    "cartesian_controller": "the control loop stood still for 1.",
}

# Many just below the timeouts, where one node notices and the other does not; of each arm's node fifty in all [s].
STALLS = (0.05, *3 * (0.11, 0.12, 0.13), 0.16, 0.4)
MORE_STALLS = (*5 * (0.11, 0.12, 0.13), *np.random.default_rng(0).uniform(0.05, 0.4, 23).tolist())
ALONE = 0.15  # one arm may be engaged without the other, after both run again [s]
CONTROLLER = "/cartesian_controller"
STOPPED = f"{CONTROLLER} is stopped: stopped by {CONTROLLER}/stop; {CONTROLLER}/reset activates again"


@pytest.fixture(scope="module")
def teleop(
    domain: int, robot: Robot, interfaces: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Teleoperation]:
    """All nodes and a connected headset."""
    folder = tmp_path_factory.mktemp("faults")
    processes = Processes(folder, os.environ)
    with spun_node(domain) as node:
        nodes = TeleopNodes(node, robot, processes)
        try:
            with teleoperation(nodes, NODES[:-1]) as running:
                yield running
        finally:
            processes.end_all()


@pytest.fixture
def moving(teleop: Teleoperation) -> Teleoperation:
    """Both arms follow their hands, whatever state an earlier test has left."""
    for name in NODES:
        teleop.restore(name)
    teleop.move()
    return teleop


@pytest.mark.parametrize("name", KILLED)
def test_a_killed_node_stops_both_arms_and_its_restart_moves_none(
    name: str, moving: Teleoperation, record_property: Record
) -> None:
    again = partial(moving.move_again, name)
    stop = moving.measure_stop(f"{name} killed", partial(moving.nodes.kill, name), again, record_property)
    moving.nodes.wait_for_diagnosis(stop.fault, KILLED[name], " for 0.")
    moving.restore(name)
    moving.assert_only_a_press_moves(stop)


def test_a_killed_robot_is_reported_and_gets_no_old_command_when_it_is_restarted(moving: Teleoperation) -> None:
    nodes = moving.nodes
    fault = nodes.kill("mujoco_robot")
    nodes.wait_for_diagnosis(fault, "left_tool_frame on /tf from /mujoco_robot is 0.")
    nodes.wait_for_diagnosis(fault, "no joint states from /mujoco_robot for 0.1")
    wait_until(lambda: nodes.controller_is("inactive", fault), "the controller has braked")
    time.sleep(0.1)
    silence = time.monotonic()
    moving.restore("mujoco_robot")
    wait_until(lambda: nodes.joints.since(silence), "the robot is back")
    back = nodes.joints.since(silence)[0]
    nodes.wait_until_ready()
    time.sleep(AWHILE)
    # The controller may have found the robot before this test did; whatever it commands, it is where the robot stands.
    commands = [np.abs(q - back.q).max() for t, q in nodes.commands if t > silence]
    assert commands, "the controller holds the arms where they are"
    assert max(commands) < STILL
    assert nodes.joints.farthest_from(back.q, back.t) < STILL
    moving.operator.rest()
    moving.press()
    moving.move()


def test_a_killed_script_stops_both_arms_and_its_restart_waits_for_a_request(
    teleop: Teleoperation, record_property: Record
) -> None:
    """Started by a user it plays at once; restarted with start_on_request it does not."""
    nodes = teleop.nodes
    for name in NODES:
        teleop.restore(name)
    teleop.operator.online = False
    try:
        wait_until(lambda: not any(map(nodes.engaged, ARMS)), "the headset is off")
        teleop.play()
        name = "simulation_input"
        stop = teleop.measure_stop(f"{name} killed", lambda: nodes.kill(name), teleop.play, record_property)
        nodes.wait_for_diagnosis(stop.fault, "of the left hand from /simulation_input")
        nodes.start("simulation_input", "start_on_request:=true")
        back = time.monotonic()
        nodes.wait_for_diagnosis(back, "waits for a call of ~/start")
        time.sleep(3.0 * AWHILE)  # longer than it takes the script to press and move
        assert nodes.joints.farthest_from(stop.posture, stop.t) < STILL
        assert call(nodes.node, "/simulation_input/start").success
        wait_until(lambda: nodes.moving, "both arms follow again")
        assert nodes.joints.fastest(back) < FAST
    finally:
        nodes.kill("simulation_input")
        teleop.operator.rest()
        teleop.operator.online = True


def test_a_press_against_a_stopped_controller_says_why_nothing_follows_and_what_helps(moving: Teleoperation) -> None:
    nodes = moving.nodes
    since = time.monotonic()
    assert call(nodes.node, "/cartesian_controller/stop").success
    nodes.wait_for_diagnosis(since, STOPPED)
    wait_until(lambda: not any(map(nodes.engaged, ARMS)), "both arms are paused")
    moving.operator.rest()
    pressed = time.monotonic()
    moving.operator.press(*ARMS)
    time.sleep(AWHILE)
    for arm in ARMS:
        lines = [one.line for one in nodes.diagnoses if one.t > pressed and one.node.startswith(f"/{arm}")]
        assert lines
        assert all(line == STOPPED for line in lines)
    assert not any(map(nodes.engaged, ARMS))
    assert call(nodes.node, "/cartesian_controller/reset").success
    moving.move()


@pytest.mark.slow
@pytest.mark.parametrize("stalls", [STALLS, pytest.param(MORE_STALLS, marks=pytest.mark.soak)], ids=["few", "more"])
@pytest.mark.parametrize("name", [f"{arm}_arm_controller" for arm in ARMS])
def test_however_short_an_arm_s_node_stops_either_both_arms_go_on_or_none(
    name: str, stalls: Sequence[float], moving: Teleoperation
) -> None:
    nodes = moving.nodes
    for stall in stalls:
        moving.move()
        nodes.signal(name, signal.SIGSTOP)
        time.sleep(stall)
        woken = nodes.signal(name, signal.SIGCONT)
        time.sleep(AWHILE)
        alone = nodes.alone(woken)
        if alone > ALONE:
            skip_if_overloaded(f"one arm was engaged alone for {alone:.2f} s")
        assert alone <= ALONE, f"stopped for {stall} s"
        moving.operator.rest()


@pytest.mark.parametrize("name", FROZEN)
def test_a_frozen_node_stops_both_arms_and_moves_none_when_it_continues(
    name: str, moving: Teleoperation, record_property: Record
) -> None:
    nodes = moving.nodes
    freeze = partial(nodes.signal, name, signal.SIGSTOP)
    stop = moving.measure_stop(f"{name} frozen", freeze, partial(moving.move_again, name), record_property)
    time.sleep(max(stop.fault + 1.0 - time.monotonic(), 0.0))
    woken = nodes.signal(name, signal.SIGCONT)
    nodes.wait_for_diagnosis(woken, FROZEN[name])
    moving.assert_only_a_press_moves(stop)
