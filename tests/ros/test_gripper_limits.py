"""Grippers ask the controller before they move. As in the pipeline, fingers are monitored at their real openings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.config.external import GripperSettings
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes
from tests.support.object_cell import ABOVE, BESIDE
from tests.support.object_cell import CELL as BLOCK_CELL

need_ros()

import pinocchio as pin
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from q2r2_control.ros.base_node import LATCHED_QOS, STREAM_QOS
from q2r2_control.ros.bridge.gripper_client import GripperClient, OpeningGrants
from tests.ros.cell import PATIENT, STILL, Cell, Stream, changed_cell, start_controller, start_robot
from tests.ros.processes import wait_until

pytestmark = pytest.mark.alone

_ARRIVED = 0.002  # Largest distance of a tool that has reached its target [m].
_FINGERS = ("left_finger_joint_1", "left_finger_joint_2")


class Gripper:
    """Commands the left gripper as an arm's node does, and reads the measured motion of its fingers."""

    def __init__(self, cell: Cell) -> None:
        self.began = 0.0
        self._cell, self.opening = cell, 1.0  # Measured opening, from 0 (closed) to 1 (open).
        cell.node.create_subscription(JointState, "/joint_states", self._on_joint_state, STREAM_QOS)
        self.grants = OpeningGrants(cell.node, "/cartesian_controller", "left", "/q2r2/left/target_frame")
        self.client = GripperClient(cell.node, "/q2r2/left_gripper/gripper_cmd", GripperSettings(), self.grants)

    def _on_joint_state(self, message: JointState) -> None:
        found = [at for name, at in zip(message.name, message.position, strict=True) if name in _FINGERS]
        self.opening = float(np.mean(found)) / BLOCK_CELL.arms["left"].gripper.open_position

    def wait_until(self, condition: Callable[[], object], what: str) -> None:
        def ticked() -> object:
            self.client.check(time.monotonic())
            return condition()

        wait_until(ticked, what, lambda: (self.opening, self.grants.granted, self.client.state, self._cell.states))

    def pass_time(self, seconds: float) -> None:
        self.began = time.monotonic()
        self.wait_until(lambda: time.monotonic() - self.began > seconds, "time passes")

    def close(self) -> None:
        def asked() -> bool:
            self.client.command(True, time.monotonic())
            return self.client.problem is None

        wait_until(asked, "the gripper has a server")


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> str:
    data = BLOCK_CELL.model_dump(mode="json")
    data["arms"]["right"]["gripper"]["object"] = {}
    alone: dict[str, Any] = {"objects": {}}  # No object is in the gripper's way.
    folder = tmp_path_factory.mktemp("cell")
    return changed_cell(folder, obstacles=data["obstacles"], arms=data["arms"], mujoco=alone)


@pytest.fixture(scope="module")
def cell(module_node: Any, module_processes: Processes, config: str) -> Iterator[Cell]:
    simulated = start_robot(module_processes, config=config)
    controller = start_controller(module_processes, *PATIENT, config=config)
    cell = Cell(module_node, Robot.from_config(BLOCK_CELL), simulated, controller)
    cell.wait_until_active()
    yield cell
    cell.end_streams()


def _go(stream: Stream, goal: pin.SE3) -> None:
    stream.move("left", tuple(goal.translation - stream.poses["left"].translation))
    stream.poses["left"] = goal


def test_a_gripper_that_is_commanded_to_close_but_stands_still_counts_as_holding_an_object(cell: Cell) -> None:
    wanted = cell.node.create_publisher(Float64MultiArray, "/q2r2/right/target_frame/wanted_opening", LATCHED_QOS)
    assert cell.state("right_holds_object") is False
    wanted.publish(Float64MultiArray(data=[0.3, math.nan]))  # The gripper gets no goal, so it stays open.
    wait_until(lambda: cell.state("right_holds_object") is True, "the object counts")
    cell.stop_and_reset()
    wait_until(lambda: cell.state("phase") == "active", "the arms are active")
    wait_until(lambda: cell.state("right_holds_object") is True, "it still does")
    wanted.publish(Float64MultiArray(data=[1.0, math.nan]))
    wait_until(lambda: cell.state("right_holds_object") is False, "the object does not count any more")


def test_an_invalid_opening_is_dropped_with_a_warning_and_the_last_valid_opening_stays(cell: Cell) -> None:
    bad, topic = [0.5, 3.0], "/q2r2/left/target_frame/wanted_opening"
    gripper = Gripper(cell)
    gripper.grants.ask(1.0)
    wait_until(lambda: gripper.grants.granted == 1.0, "it is granted")
    sender = cell.node.create_publisher(Float64MultiArray, topic, LATCHED_QOS)
    sender.publish(Float64MultiArray(data=bad))
    cell.processes[1].wait_for(f"{topic}: what cannot be read is dropped, such as {bad}")
    assert gripper.grants.granted == 1.0
    cell.node.destroy_publisher(sender)


def test_a_gripper_opens_as_far_as_is_proven_safe(cell: Cell, module_processes: Processes, config: str) -> None:
    gripper = Gripper(cell)
    wait_until(lambda: gripper.grants.answered, "the controller answers")
    stream = cell.engage("left")
    _go(stream, ABOVE)
    gripper.close()
    gripper.wait_until(lambda: gripper.opening < 0.02 and gripper.client.closed, "the gripper is closed")
    # The fingers of an open gripper would be 12 mm inside the block.
    _go(stream, BESIDE)
    cell.wait_until_there("left", BESIDE, _ARRIVED)
    stream.end()
    # The arms are stopped and activated again where they are. Nothing is too close, so that nothing moves.
    rest = cell.joints.wait_for_rest()
    cell.stop_and_reset()
    wait_until(lambda: cell.state("phase") == "active", "the arms are active")
    gripper.pass_time(1.0)
    assert cell.joints.farthest_from(rest, gripper.began) < STILL

    gripper.client.command(False, time.monotonic())
    gripper.wait_until(lambda: cell.state("left_gripper_held_by"), "the block holds the gripper")
    assert "block" in cell.state("left_gripper_held_by")
    gripper.wait_until(lambda: gripper.opening > 0.3, "the gripper opens as far as it may")
    gripper.pass_time(1.0)
    assert 0.3 < gripper.opening < 0.5
    assert gripper.client.state == "opening"

    cell.processes[1].interrupt()
    gripper.wait_until(lambda: gripper.client.problem, "the gripper's client gives up")
    assert "the controller that grants openings has ended" in str(gripper.client.problem)
    rest = cell.joints.wait_for_rest()
    cell.states.clear()
    start_controller(module_processes, *PATIENT, config=config)
    wait_until(lambda: cell.state("phase") == "active", "the new controller is active")
    gripper.pass_time(1.5)
    # The gripper is as open as is proven safe, so the arms stay. They may only correct about a millimetre of error.
    assert cell.joints.tool_farthest_from(rest, gripper.began) < 0.002
    assert 0.3 < gripper.opening < 0.5

    gripper.client.command(False, time.monotonic())
    _go(cell.engage("left"), ABOVE)
    gripper.wait_until(lambda: gripper.opening > 0.98, "the gripper opens by itself where there is room")
    gripper.wait_until(lambda: gripper.client.state == "open", "the goal has its result")
    wait_until(lambda: cell.state("left_gripper_held_by") == "", "nothing holds it")
