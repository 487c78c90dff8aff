"""The controller as a managed node. It lets the arms rest before it answers, and sends no commands while inactive.

No arm ever jumps.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.ros.reasons import RosReason
from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import Processes

need_ros()

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.events import Reason
from q2r2_control.ros.base_node import STREAM_QOS
from q2r2_control.wording import sentence
from tests.ros.cell import PATIENT, SOFT, Cell, changed_cell, shifted, start_controller, start_robot
from tests.ros.processes import wait_until

pytestmark = pytest.mark.alone


STILL = 5e-3  # A joint at rest moves less than this [rad].


class Managed(Cell):
    def __init__(self, node: Any, robot: Robot, *processes: Any) -> None:
        super().__init__(node, robot, *processes)
        self.commands: list[JointTrajectory] = []
        node.create_subscription(JointTrajectory, "/joint_trajectory", self.commands.append, STREAM_QOS)
        self.commander = node.create_publisher(JointTrajectory, "/joint_trajectory", 1)
        self._change = node.create_client(ChangeState, "/cartesian_controller/change_state")
        self._get = node.create_client(GetState, "/cartesian_controller/get_state")

    def ask(self, transition: int) -> bool:
        wait_until(self._change.service_is_ready, "the lifecycle's services are there")
        future = self._change.call_async(ChangeState.Request(transition=Transition(id=transition)))
        wait_until(future.done, "the transition is answered")
        return bool(future.result().success)

    def lifecycle(self) -> str:
        future = self._get.call_async(GetState.Request())
        wait_until(future.done, "the state is answered")
        return str(future.result().current_state.label)

    def command(self, q: Any) -> None:
        point = JointTrajectoryPoint(positions=[float(value) for value in q])
        self.commander.publish(JointTrajectory(joint_names=list(self.robot.joint_names), points=[point]))

    def move_by_another(self, q: Any) -> None:
        """Move the joints evenly to ``q`` [rad] within a second, by commands of another node."""
        start, began = self.q.copy(), time.monotonic()
        while (share := time.monotonic() - began) < 1.5:
            self.command(start + min(share, 1.0) * (q - start))
            time.sleep(0.01)


@pytest.fixture(scope="module")
def cell(module_node: Any, module_processes: Processes, robot: Robot) -> Managed:
    started = start_robot(module_processes), start_controller(module_processes, *PATIENT)
    cell = Managed(module_node, robot, *started)
    cell.wait_until_active()
    return cell


def test_the_controller_starts_active_and_brings_the_arms_to_rest_before_it_answers_a_deactivation(
    cell: Managed, robot: Robot
) -> None:
    assert cell.lifecycle() == "active"
    stream = cell.engage("left")
    stream.move("left", (0.0, 0.0, 0.15))
    wait_until(lambda: np.abs(cell.joints.states[-1].v).max() > 0.05, "the arm moves")
    assert cell.ask(Transition.TRANSITION_DEACTIVATE)
    assert cell.lifecycle() == "inactive"
    assert not cell.ask(Transition.TRANSITION_CLEANUP)
    last = np.array(cell.commands[-1].points[0].velocities)
    assert np.abs(last).max() < 1e-3  # The last command is at rest.
    time.sleep(0.3)
    cell.commands.clear()
    at_rest = cell.q.copy()
    time.sleep(0.5)
    stream.end()
    assert not cell.commands
    assert np.abs(cell.q - at_rest).max() < STILL
    answer = cell.call("/cartesian_controller/reset")
    assert not answer.success
    assert "ros2 lifecycle set" in answer.message
    wait_until(lambda: cell.state("left_state") == "deactivated", "its state says so")


def test_the_controller_activates_where_another_node_left_the_arms_as_soon_as_the_other_node_is_silent(
    cell: Managed, robot: Robot
) -> None:
    if cell.lifecycle() == "active":
        assert cell.ask(Transition.TRANSITION_DEACTIVATE)
    goal = cell.q.copy()
    goal[robot.arms["right"].joints[5]] += 0.3
    cell.move_by_another(goal)
    timer = cell.node.create_timer(0.02, lambda: cell.command(goal))
    assert np.abs(cell.q - goal).max() < 0.02
    assert not cell.ask(Transition.TRANSITION_ACTIVATE)
    assert cell.lifecycle() == "inactive"
    why = sentence(Reason.of(RosReason.OTHER_COMMANDER, nodes="/test", topic="/joint_trajectory"))
    wait_until(lambda: why in cell.processes[1].output, "the log says why")
    cell.node.destroy_timer(timer)
    time.sleep(0.5)
    cell.commands.clear()
    before = cell.q.copy()
    assert cell.ask(Transition.TRANSITION_ACTIVATE)
    wait_until(lambda: cell.commands, "it commands")
    first = cell.commands[0]
    order = [first.joint_names.index(name) for name in robot.joint_names]
    assert np.abs(np.array(first.points[0].positions)[order] - before).max() < STILL
    time.sleep(0.5)
    assert np.abs(cell.q - before).max() < 2.0 * STILL
    assert cell.lifecycle() == "active"


@pytest.mark.parametrize("output", ["velocity", "torque"])
def test_with_velocity_or_torque_commands_the_arms_rest_when_the_controller_is_deactivated_or_activated(
    domain: int, module_processes: Processes, processes: Processes, robot: Robot, output: str, tmp_path: Path
) -> None:
    module_processes.end_all()  # The nodes of this process have the same names.
    config = changed_cell(tmp_path, impedance=SOFT)
    with spun_node(domain) as node:
        controller = start_controller(processes, *PATIENT, f"output:={output}", config=config)
        cell = Managed(node, robot, start_robot(processes), controller)
        cell.wait_until_active()
        stream = cell.engage("left")
        goal = shifted(stream.poses["left"], 0.0, 0.0, 0.1)
        stream.move("left", (0.0, 0.0, 0.1), speed=0.1)
        cell.wait_until_there("left", goal, 4e-3)
        assert cell.state("mode", "mujoco_robot") == ("torque" if output == "torque" else "position")
        assert cell.ask(Transition.TRANSITION_DEACTIVATE)
        stream.end()
        at_rest = cell.joints.wait_for_rest()
        cell.forget()
        assert cell.ask(Transition.TRANSITION_ACTIVATE)
        time.sleep(0.5)
        assert np.abs(np.array(cell.postures) - at_rest).max() < 2.0 * STILL
        os.kill(controller.pid, signal.SIGKILL)
        wait_until(lambda: cell.state("mode", "mujoco_robot") == "holding", "the robot holds")
        time.sleep(0.5)
        assert np.abs(np.array(cell.postures) - at_rest).max() < 2.0 * STILL
