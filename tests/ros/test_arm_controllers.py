"""Both arms' nodes in one process: their faults stay told apart, and one process that fails stops both arms."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from functools import partial

import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes
from tests.ros.waiting import call, wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from q2r2_control.ros.monitoring.hand_listeners import PAUSED_BY_SERVICE  # noqa: E402
from tests.ros.teleop_nodes import ARMS, TeleopNodes  # noqa: E402
from tests.ros.teleoperation import Record, Teleoperation, teleoperation  # noqa: E402

BOTH = "arm_controllers"


@pytest.fixture(scope="module")
def running(
    domain: int, robot: Robot, interfaces: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Teleoperation]:
    processes = Processes(tmp_path_factory.mktemp("arm_controllers"), os.environ)
    with spun_node(domain) as node:
        try:
            names = ("mujoco_robot", "cartesian_controller", BOTH)
            with teleoperation(TeleopNodes(node, robot, processes), names) as started:
                yield started
        finally:
            processes.end_all()


@pytest.fixture
def moving(running: Teleoperation) -> Teleoperation:
    """Both arms follow their hands, whatever state an earlier test has left."""
    running.restore(BOTH)
    running.move()
    return running


@pytest.mark.parametrize("arm", ARMS)
def test_what_pauses_one_arm_is_said_by_its_node_and_pauses_the_other_as_linked(
    arm: str, moving: Teleoperation
) -> None:
    nodes = moving.nodes
    (other,) = set(ARMS) - {arm}
    since = time.monotonic()
    assert call(nodes.node, f"/{arm}_q2r2_arm_controller/pause").success
    wait_until(lambda: not any(map(nodes.engaged, ARMS)), "both arms are paused")
    for name, line in ((arm, PAUSED_BY_SERVICE), (other, f"linked to {arm}: ")):
        nodes.wait_for_diagnosis(since, line)
        said = [one.line for one in nodes.diagnoses if one.t > since and one.node == f"/{name}_q2r2_arm_controller"]
        assert any(line in text for text in said)
        assert name == other or not any("linked" in text for text in said)


def test_the_process_killed_stops_both_arms_and_its_restart_moves_none(
    moving: Teleoperation, record_property: Record
) -> None:
    again = partial(moving.move_again, BOTH)
    stop = moving.measure_stop(f"{BOTH} killed", partial(moving.nodes.kill, BOTH), again, record_property)
    moving.restore(BOTH)
    moving.assert_only_a_press_moves(stop)


def test_the_process_frozen_stops_both_arms_and_moves_none_when_it_continues(
    moving: Teleoperation, record_property: Record
) -> None:
    nodes = moving.nodes
    freeze = partial(nodes.signal, BOTH, signal.SIGSTOP)
    stop = moving.measure_stop(f"{BOTH} frozen", freeze, partial(moving.move_again, BOTH), record_property)
    time.sleep(max(stop.fault + 1.0 - time.monotonic(), 0.0))
    woken = nodes.signal(BOTH, signal.SIGCONT)
    nodes.wait_for_diagnosis(woken, "this node stood still for 1.")
    moving.assert_only_a_press_moves(stop)


def test_a_wrong_parameter_of_one_arm_ends_both_in_one_line(processes: Processes) -> None:
    process = processes.start(
        *(sys.executable, "-m", "q2r2_control.ros.nodes.arm_controllers"),
        *("--ros-args", "-p", "right_q2r2_arm_controller:rate:=-1.0"),
        name=BOTH,
    )
    assert process.wait() == 2
    assert "parameter rate: " in process.output.splitlines()[-1]
