"""What is for both arms, in nodes: the way home and a stop, asked for by either hand; the simulated arms do it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

from std_msgs.msg import Float64MultiArray

from q2r2_control.ros.base_node import LATCHED_QOS
from tests.ros.arm_rig import HOLDING, ArmRigs
from tests.ros.cockpit import Cockpit
from tests.ros.waiting import call, wait_until

pytestmark = pytest.mark.alone

BINDINGS = {
    "teleop.bindings.grip": "home",
    "teleop.bindings.lower_hold": "stop",
    "teleop.bindings.upper_hold": "swap_hands",
}
HOME, STILL = 0.01, 0.005  # [rad]


@pytest.fixture(scope="module")
def started(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cockpit]:
    processes = Processes(tmp_path_factory.mktemp("cockpit"), os.environ)
    with spun_node(domain) as node:
        yield Cockpit(node, robot, processes, BINDINGS)
        processes.end_all()


@pytest.fixture
def cockpit(started: Cockpit) -> Iterator[Cockpit]:
    started.go_away()
    yield started
    for arm in ("left", "right"):
        assert call(started.cell.node, f"/{arm}_q2r2_arm_controller/reset").success


def test_the_way_home_that_one_hand_asks_for_brings_both_arms_home_and_a_press_engages_them_there(
    cockpit: Cockpit,
) -> None:
    cockpit.ask_for_home()
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "both arms are paused")
    cockpit.rigs.wait(lambda rig: rig.state["last_event"] == "paused: at home", "and say why")
    assert cockpit.from_home < HOME
    cockpit.rigs.engage()
    assert cockpit.from_home < HOME


def test_a_button_closes_and_opens_a_gripper_as_far_as_the_controller_grants(cockpit: Cockpit) -> None:
    answers: list[list[float]] = []
    topic = "/cartesian_controller/opening/left"
    heard = cockpit.cell.node.create_subscription(
        Float64MultiArray, topic, lambda message: answers.append(list(message.data)), LATCHED_QOS
    )
    left = cockpit.left
    left.press("upper")
    left.wait(lambda: left.state["gripper"] == "closed", "the gripper is closed")
    left.press("upper")
    left.wait(lambda: left.state["gripper"] == "open", "the gripper is open")
    assert answers == [[0.0, 0.0], [1.0, 1.0]]
    cockpit.cell.node.destroy_subscription(heard)


def test_a_press_of_the_other_hand_ends_the_way_home_where_the_arms_are(cockpit: Cockpit) -> None:
    cockpit.ask_for_home()
    cockpit.right.press("upper")
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "both arms are paused")
    rest = cockpit.cell.joints.wait_for_rest()
    assert cockpit.from_home > 2.0 * HOME
    time.sleep(1.0)
    assert np.abs(cockpit.cell.q - rest).max() < STILL
    cockpit.rigs.wait(lambda rig: rig.state["ready"], "they can be engaged")


def test_the_way_home_that_somebody_else_asks_for_is_told_to_both_hands(cockpit: Cockpit) -> None:
    assert call(cockpit.cell.node, "/cartesian_controller/home").success
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "homing", "both arms are on their way home")
    cockpit.left.press("upper")
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "a press ends it")


def test_a_stop_of_one_hand_stops_both_arms_until_either_takes_it_back(cockpit: Cockpit) -> None:
    cockpit.hold_lower(cockpit.left)
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "stopped", "both arms are stopped")
    rest = cockpit.cell.joints.wait_for_rest()
    cockpit.right.press()
    cockpit.right.wait(
        lambda: cockpit.right.state["last_event"] == "stopped: not engaged: stopped, lower held goes on",
        "a press is refused",
    )
    cockpit.rigs.move((0.1, 0.0, 0.0), 0.5)
    assert np.abs(cockpit.cell.q - rest).max() < STILL
    cockpit.hold_lower(cockpit.right)
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "it is taken back for both")
    assert np.abs(cockpit.cell.q - rest).max() < STILL
    cockpit.rigs.engage()


def test_hands_that_are_swapped_drive_the_other_arm_once_both_arms_are_paused(cockpit: Cockpit) -> None:
    left, right = cockpit.left, cockpit.right
    cockpit.rigs.pause()
    cockpit.hold_upper(left)
    cockpit.rigs.wait(lambda rig: rig.state["hand"] != rig.arm, "the hands are swapped")
    cockpit.rigs.wait(lambda rig: rig.state["ready"], "the hands are seen")
    rest = cockpit.cell.joints.wait_for_rest()
    hand = ArmRigs([left])
    hand.press_until(lambda _: right.state["engaged"], "the left hand engages the right arm")
    left.move((0.0, 0.0, 0.06), 0.6)
    joints = cockpit.cell.robot.arms
    wait_until(lambda: np.abs(cockpit.cell.q - rest)[joints["right"].joints].max() > 0.03, "the right arm follows")
    assert np.abs(cockpit.cell.q - rest)[joints["left"].joints].max() < STILL
    hand.press_until(lambda _: right.state["state"] in HOLDING, "and pauses it")
    cockpit.hold_upper(right)
    cockpit.rigs.wait(lambda rig: rig.state["hand"] == rig.arm, "the hands are swapped back")


def test_a_stop_is_taken_back_by_the_reset_of_an_arms_node_too(cockpit: Cockpit) -> None:
    cockpit.hold_lower(cockpit.right)
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "stopped", "both arms are stopped")
    assert call(cockpit.cell.node, "/left_q2r2_arm_controller/reset").success
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "it is taken back for both")


def test_an_arms_node_that_is_restarted_learns_of_a_stop(cockpit: Cockpit) -> None:
    from q2r2_control.ros.monitoring.arm_link import ArmLink

    cockpit.hold_lower(cockpit.left)
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "stopped", "both arms are stopped")
    link = ArmLink(cockpit.cell.node, "q2r2", "right", "side_by_side", 1.0)  # as the restarted one's
    wait_until(lambda: link.stopped, "it is told")
    link.set_stopped(False)
    cockpit.left.wait(lambda: cockpit.left.state["state"] == "paused", "what it says counts")
    link.close()
