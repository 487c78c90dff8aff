"""A loop in this process moves a robot behind ROS, and does not disturb it if others move it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

from q2r2_control import Pipeline, Robot, load_config
from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError
from q2r2_control.inputs.policy import PolicyInput
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, PATIENCE, Processes

need_ros()

from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.ros import plant as plant_module
from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.ros.bridge.messages import joint_state_message
from q2r2_control.ros.plant import RosPlant
from tests.ros.cell import NODE_RATE, Cell, start_robot
from tests.ros.processes import subscribed, wait_until

UNDER_WAY = 10  # Number of commands that a new receiver may get before the loop notices it.
MOVED = 0.1  # Motion of one joint [rad].


@pytest.fixture
def config() -> Config:
    return load_config(CONFIG).model_copy(update={"loop_rate_hz": NODE_RATE})


@pytest.fixture
def cell(node: Any, processes: Processes, robot: Robot) -> Cell:
    made = Cell(node, robot, start_robot(processes))
    wait_until(lambda: made.joints.states, "joint states come")
    return made


@contextmanager
def driven(config: Config, robot: Robot, goal: np.ndarray) -> Iterator[tuple[list[Tick], Callable[[], RunSummary]]]:
    """Return a run whose policy moves the joints slowly to ``goal`` and closes the left gripper."""
    policy, ticks, ended = PolicyInput(rate=20.0), list[Tick](), Event()
    loop = Pipeline(config, robot, policy, RosPlant(robot, config))
    found: list[RunSummary] = []

    def lead(tick: Tick) -> None:
        ticks.append(tick)
        if len(ticks) % 10 == 0:
            way = np.clip(goal - tick.state.q, -0.05, 0.05)
            policy.send([*(tick.state.q + way), 0.0, 1.0])

    def run() -> None:
        found.append(loop.run())
        ended.set()

    def summary() -> RunSummary:
        loop.stop()
        wait_until(ended.is_set, "the run ends")
        return found[0]

    loop.listeners.append(lead)
    thread = Thread(target=run, daemon=True)
    thread.start()
    try:
        yield ticks, summary
    finally:
        loop.stop()
        thread.join()


def test_a_policy_moves_the_arms_and_a_gripper_of_a_robot_behind_ros(cell: Cell, config: Config) -> None:
    goal = cell.q.copy()
    goal[3] += MOVED
    with driven(config, cell.robot, goal) as (ticks, summary):
        wait_until(lambda: np.abs(cell.q - goal).max() < 5e-3, "the arms are there")
        wait_until(lambda: ticks[-1].openings["left"] < 0.05, "the left gripper is closed")
        assert ticks[-1].openings["right"] > 0.95
        assert summary().arms["left"].policy_s > 0.0


def test_arms_rest_when_the_robot_ends_and_go_on_without_a_jump_from_the_posture_of_a_new_robot(
    cell: Cell, config: Config, processes: Processes
) -> None:
    goal = cell.q.copy()
    goal[3] += MOVED
    with driven(config, cell.robot, goal) as (ticks, _):
        wait_until(lambda: np.abs(cell.q - goal).max() < 5e-3, "the arms are there")
        cell.processes[0].end()
        wait_until(lambda: ticks[-1].states["left"] != "policy", "the policy has not the arms any more")
        lost = len(ticks)
        start_robot(processes)  # The new robot is at home.
        cell.forget()
        wait_until(lambda: np.abs(cell.q - goal).max() < 5e-3, "the arms are there again")
        # The test checks only the commands. On a busy machine, two commands may arrive together, and the robot then
        # moves fast.
        again = [tick for tick in ticks[lost:] if tick.states["left"] == "policy"]
        assert np.abs(again[0].state.q - goal).max() > 0.9 * MOVED, "no command from before has moved it"
        assert np.abs(again[0].command.q - again[0].state.q).max() < 0.03
        # The policy moves a joint by at most 0.05 rad, in a twentieth of a second.
        assert max(np.abs(tick.reference.v).max() for tick in again) < 1.5


def test_a_new_receiver_gets_no_commands_while_the_arms_are_elsewhere(
    node: Any, robot: Robot, config: Config, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The arms of this test never move, so the check for arms that stand still is off.
    monkeypatch.setattr(RosPlant, "standstill", None)
    states = node.create_publisher(JointState, "joint_states", 10)
    still = joint_state_message(robot.joint_names, robot.home, 0.0 * robot.home, 0.0 * robot.home, 0.0)
    timer = node.create_timer(0.01, lambda: states.publish(still))
    node.create_subscription(JointTrajectory, "joint_trajectory", lambda _: None, COMMAND_QOS)
    goal = robot.home.copy()
    goal[3] += MOVED
    try:
        with driven(config, robot, goal) as (ticks, _):
            wait_until(lambda: ticks and np.abs(ticks[-1].reference.q - robot.home).max() > 0.04, "a command is away")
            heard = subscribed(node, JointTrajectory, "joint_trajectory", COMMAND_QOS)
            # The middleware notices the receiver before the loop does. Commands that are sent meanwhile are delivered.
            commands = (heard.get(timeout=PATIENCE).points[0].positions for _ in range(UNDER_WAY))
            assert any(np.abs(np.array(command) - robot.home).max() < 0.03 for command in commands)
            assert "a new receiver takes the commands" in caplog.text
    finally:
        timer.cancel()


@pytest.mark.parametrize("begins", ["a publisher that appears", "one that was silent"])
def test_if_another_node_commands_the_arms_they_are_released_and_the_other_node_is_named(
    begins: str, cell: Cell, config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    goal, other = cell.q.copy(), None
    goal[3] += 4.0 * MOVED
    if begins == "one that was silent":
        other = cell.node.create_publisher(JointTrajectory, "joint_trajectory", COMMAND_QOS)
    with driven(config, cell.robot, goal) as (ticks, _):
        wait_until(lambda: len(ticks) > 3.0 * NODE_RATE, "the loop has driven for some seconds")
        if other is None:
            other = cell.node.create_publisher(JointTrajectory, "joint_trajectory", COMMAND_QOS)
        else:
            assert "commands the arms" not in caplog.text
            other.publish(JointTrajectory())
        wait_until(lambda: "/test commands the arms on /joint_trajectory" in caplog.text, "the other is named")


def test_a_plant_whose_arms_are_missing_or_commanded_by_other_nodes_raises_an_error_of_one_line(
    node: Any, robot: Robot, config: Config, processes: Processes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plant_module, "_WAIT", 0.5)
    plant = RosPlant(robot, config)
    with pytest.raises(PlantError, match="no joint states yet"):
        plant.reset()
    monkeypatch.undo()
    cell = Cell(node, robot, start_robot(processes))
    wait_until(lambda: cell.joints.states, "joint states come")
    other = node.create_publisher(JointTrajectory, "joint_trajectory", COMMAND_QOS)
    timer = node.create_timer(0.02, lambda: other.publish(JointTrajectory()))
    monkeypatch.setattr(plant_module, "_QUIET", 4.0)  # Discovery takes long on a busy machine.
    try:
        with pytest.raises(PlantError, match="/test commands the arms on /joint_trajectory"):
            plant.reset()
        with pytest.raises(PlantError, match="starts where it stands"):
            plant.reset(robot.home)
    finally:
        timer.cancel()
        plant.close()
