"""One publisher a target topic: a second one stops the arm and is named, one that was started again is not a second."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import PATIENCE, Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

import pinocchio as pin

from tests.ros.cell import STILL, Cell, Stream, shifted, start_controller, start_robot
from tests.ros.waiting import wait_until

TOPIC = "/q2r2/left/target_frame"


@pytest.fixture(scope="module")
def cell(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    processes = Processes(tmp_path_factory.mktemp("cell"), os.environ)
    # Longer than gaps on an overloaded machine, and shorter than starting a program takes.
    patient = ("joint_state_timeout:=0.5", "target_timeout:=0.3")
    with spun_node(domain) as node:
        made = Cell(node, robot, start_robot(processes), start_controller(processes, *patient))
        made.wait_until_active()
        yield made
        processes.end_all()


@pytest.fixture
def stream(cell: Cell) -> Iterator[Stream]:
    """Targets of this process that the left arm follows."""
    wait_until(lambda: cell.state("level") == "ok", "what the test before left is forgotten")
    begun = cell.engage("left")
    yield begun
    begun.end()
    wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")


def start_sender(processes: Processes, pose: pin.SE3) -> RosProcess:
    (x, y, z), (qx, qy, qz, qw) = pose.translation.tolist(), pin.Quaternion(pose.rotation).coeffs().tolist()
    position, orientation = {"x": x, "y": y, "z": z}, {"x": qx, "y": qy, "z": qz, "w": qw}
    message = {"header": {"frame_id": "world"}, "pose": {"position": position, "orientation": orientation}}
    program = "tests.ros.programs.publish"
    return processes.start_module(program, "geometry_msgs/PoseStamped", TOPIC, json.dumps(message))


def test_a_second_publisher_in_mid_motion_stops_the_arm_and_is_named(
    cell: Cell, robot: Robot, stream: Stream, processes: Processes
) -> None:
    output = cell.processes[1].output
    # The other one would have the arm 20 cm away.
    start_sender(processes, shifted(cell.tool("left"), 0.0, 0.0, 0.2))
    begin = stream.poses["left"]
    deadline = time.monotonic() + PATIENCE
    # A newcomer's name takes a moment to be known.
    while "two publishers at a time from /sender and /test; allowed: one" not in str(cell.state("message")):
        assert time.monotonic() < deadline, cell.state("message")
        stream.move("left", (0.0, 0.02, 0.0), speed=0.1)
        stream.move("left", (0.0, -0.02, 0.0), speed=0.1)
    assert cell.state("level") == "warn"
    wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
    rest = cell.joints.wait_for_rest()
    added = cell.processes[1].output[len(output) :]
    assert "target of left not used: two publishers at a time" in added
    # What the arm did meanwhile: nothing but its own 2 cm.
    farthest = max(np.linalg.norm(tool - begin.translation) for tool in tools(cell, robot))
    assert farthest < 0.03
    steps = np.abs(np.diff(cell.postures, axis=0))
    assert steps.max() < 0.02
    time.sleep(0.5)
    assert np.abs(cell.q - rest).max() < STILL


def tools(cell: Cell, robot: Robot) -> list[np.ndarray]:
    return [robot.tool_pose(q, "left").translation for q in cell.postures]


def test_the_stream_that_is_left_is_followed_once_it_begins_anew(
    cell: Cell, stream: Stream, processes: Processes
) -> None:
    second = start_sender(processes, shifted(cell.tool("left"), 0.0, 0.0, 0.2))
    wait_until(lambda: "two publishers at a time" in str(cell.state("message")), "two publishers are reported")
    second.interrupt()
    stream.poses["left"] = shifted(stream.poses["left"], 0.0, 0.0, 0.02)
    wait_until(lambda: "the stream is" in str(cell.state("message")), "one publisher is left")
    assert cell.state("left_state") == "holding"
    stream.poses["left"] = shifted(cell.tool("left"), 0.0, 0.0, 0.2)
    time.sleep(0.1)
    stream.poses["left"] = cell.tool("left")
    wait_until(lambda: cell.state("left_state") == "following", "the arm follows")


def test_a_publisher_that_was_killed_is_named_and_is_no_second_one_when_it_is_started_again(
    cell: Cell, processes: Processes
) -> None:
    output = cell.processes[1].output
    for _ in range(2):
        sender = start_sender(processes, cell.tool("left"))
        wait_until(lambda: cell.state("left_state") == "following", "the arm follows")
        wait_until(lambda: cell.state("left_targets_from") == "/sender and /test", "the sender is known")
        os.kill(sender.pid, signal.SIGKILL)
        wait_until(lambda: cell.state("left_state") == "holding", "the arm holds")
        assert "left: targets from /sender and /test have ceased" in cell.state("message")
    added = cell.processes[1].output[len(output) :]
    assert added.count("have ceased") == 2
    assert "another publisher" not in added
    assert "two publishers" not in added
