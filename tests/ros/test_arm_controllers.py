"""Both arms' nodes share one teleoperation: what is for both arms needs no message between nodes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()

from q2r2_control.errors import ConfigError
from q2r2_control.ros.nodes.arm_controllers import LeftArmController, RightArmController
from q2r2_control.types import Array
from tests.ros.arm_rig import offset
from tests.ros.cockpit import Cockpit
from tests.ros.waiting import call, wait_until

pytestmark = pytest.mark.alone

BINDINGS = {
    "teleop.bindings.grip": "home",
    "teleop.bindings.lower_hold": "stop",
    "teleop.bindings.trigger": "carry",
}
HOME, STILL = 0.01, 0.005  # [rad]


@pytest.fixture(scope="module")
def started(module_node: Any, module_processes: Processes, robot: Robot) -> Cockpit:
    return Cockpit(module_node, robot, module_processes, BINDINGS)


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
    for rig in (left, right):
        assert rig.state["last_event_kind"] == "pause_service"
    cockpit.rigs.engage()
    left.hand = offset(left.hand, (1.0, 0.0, 0.0))
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "lost", "a jump of one hand pauses both")
    assert right.state["last_event_kind"] == "hand_jumped"


def test_an_arm_that_its_operator_pauses_stops_alone_and_the_controller_goes_on_with_the_other(
    cockpit: Cockpit,
) -> None:
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
    cockpit.ask_for_home()
    cockpit.right.press("upper")
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "both arms are paused")
    rest = cockpit.cell.joints.wait_for_rest()
    assert cockpit.from_home > 2.0 * HOME
    cockpit.rigs.wait(lambda rig: rig.state["ready"], "they can be engaged")
    assert call(cockpit.cell.node, "/cartesian_controller/home").success
    cockpit.rigs.wait(lambda rig: rig.state["last_event"] == "paused: at home", "a service brings both home")
    assert cockpit.from_home < HOME
    assert np.abs(cockpit.cell.q - rest).max() > HOME


def test_a_stop_of_one_hand_stops_both_arms_until_it_is_taken_back(cockpit: Cockpit) -> None:
    cockpit.hold(cockpit.left, "lower")
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "stopped", "both arms are stopped")
    rest = cockpit.cell.joints.wait_for_rest()
    cockpit.right.press()
    cockpit.rigs.move((0.1, 0.0, 0.0), 0.5)
    assert np.abs(cockpit.cell.q - rest).max() < STILL
    cockpit.hold(cockpit.right, "lower")
    cockpit.rigs.wait(lambda rig: rig.state["state"] == "paused", "it is taken back for both")
    assert np.abs(cockpit.cell.q - rest).max() < STILL


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
        RightArmController(context=context, partner=left, cli_args=["--ros-args", "-p", given])
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
    assert "parameter rate: " in process.output.splitlines()[-1]
