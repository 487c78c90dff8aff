"""One publisher a target topic: a second one stops the arm and is named, one that was started again is not a second."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest

from q2r2_control import Robot, load_config
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import PATIENCE, Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

import pinocchio as pin

from tests.ros.cell import CONFIG, STILL, Cell, Stream, at_rest, shifted, start, wait

TOPIC = "/q2r2/left/target_frame"


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config(CONFIG))


@pytest.fixture(scope="module")
def cell(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    processes = Processes(tmp_path_factory.mktemp("cell"), os.environ)
    # A time-out that a busy machine does not reach, and shorter than starting a program takes.
    patient = ("-p", "joint_state_timeout:=0.5", "-p", "target_timeout:=0.3")
    with spun_node(domain) as node:
        made = Cell(node, robot, start(processes, "mujoco_robot"), start(processes, "cartesian_controller", *patient))
        made.wait_until_active()
        yield made
        processes.end_all()


@pytest.fixture
def stream(cell: Cell) -> Iterator[Stream]:
    """Targets of this process that the left arm follows."""
    wait(lambda: cell.state("level") == "ok", "what the test before left is forgotten")
    begun = cell.engage("left")
    yield begun
    begun.end()
    wait(lambda: cell.state("left_state") == "holding", "the arm holds")


def start_sender(processes: Processes, pose: pin.SE3) -> RosProcess:
    numbers = [*pose.translation, *pin.Quaternion(pose.rotation).coeffs()]
    return processes.start_module("tests.ros.target_sender", TOPIC, *(repr(float(number)) for number in numbers))


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
    wait(lambda: cell.state("left_state") == "holding", "the arm holds")
    rest = at_rest(cell)
    added = cell.processes[1].output[len(output) :]
    assert "target of left not used: two publishers at a time" in added
    # What the arm did meanwhile: nothing but its own 2 cm.
    furthest = max(np.linalg.norm(tool - begin.translation) for tool in tools(cell, robot))
    assert furthest < 0.03
    steps = np.abs(np.diff([measured.q for measured in cell.measured], axis=0))
    assert steps.max() < 0.02
    time.sleep(0.5)
    assert np.abs(cell.q - rest).max() < STILL


def tools(cell: Cell, robot: Robot) -> list[np.ndarray]:
    return [robot.tool_pose(measured.q, "left").translation for measured in cell.measured]


def test_the_stream_that_is_left_is_followed_once_it_begins_anew(
    cell: Cell, stream: Stream, processes: Processes
) -> None:
    second = start_sender(processes, shifted(cell.tool("left"), 0.0, 0.0, 0.2))
    wait(lambda: "two publishers at a time" in str(cell.state("message")), "two publishers are reported")
    second.interrupt()
    stream.poses["left"] = shifted(stream.poses["left"], 0.0, 0.0, 0.02)
    wait(lambda: "the stream goes on" in str(cell.state("message")), "one publisher is left")
    assert cell.state("left_state") == "holding"
    stream.poses["left"] = shifted(cell.tool("left"), 0.0, 0.0, 0.2)
    time.sleep(0.1)
    stream.poses["left"] = cell.tool("left")
    wait(lambda: cell.state("left_state") == "following", "the arm follows")


def test_a_publisher_that_was_killed_is_named_and_is_no_second_one_when_it_is_started_again(
    cell: Cell, processes: Processes
) -> None:
    output = cell.processes[1].output
    for _ in range(2):
        sender = start_sender(processes, cell.tool("left"))
        wait(lambda: cell.state("left_state") == "following", "the arm follows")
        wait(lambda: cell.state("left_targets_from") == "/sender and /test", "the sender is known")
        os.kill(sender.pid, signal.SIGKILL)
        wait(lambda: cell.state("left_state") == "holding", "the arm holds")
        assert "left: targets from /sender and /test have ceased" in cell.state("message")
    added = cell.processes[1].output[len(output) :]
    assert added.count("have ceased") == 2
    assert "another publisher" not in added
    assert "two publishers" not in added
