"""What leaves the controller's node when its process stood still: no jump."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.types import Array
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from trajectory_msgs.msg import JointTrajectory

from tests.ros.cell import PATIENT, Cell, shifted, start_controller, start_robot
from tests.ros.waiting import wait_until

pytestmark = pytest.mark.alone

RATE = 125.0  # of the control loop [Hz]
PLACES = (-0.05, 0.2)  # above home, between which the arm becomes fast [m]
COMMANDS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST)
SAG = 0.03  # a command that begins anew is no farther from what was measured [rad]


class Commanded(NamedTuple):
    """One command: its number at the publisher, where the joints were measured then, and where they have to be."""

    number: int
    measured: Array
    q: Array
    t: float  # of its receipt [s]


class Recorder:
    """Takes every command of a controller."""

    def __init__(self, cell: Cell, robot: Robot) -> None:
        self.commands: list[Commanded] = []
        self._cell, self._names = cell, robot.joint_names
        cell.node.create_subscription(JointTrajectory, "/joint_trajectory", self._take, COMMANDS)

    def _take(self, message: JointTrajectory, info: Mapping[str, Any]) -> None:
        place = {name: index for index, name in enumerate(message.joint_names)}
        q = np.array([message.points[0].positions[place[name]] for name in self._names])
        measured = self._cell.q if self._cell.postures else q
        self.commands.append(Commanded(info["publication_sequence_number"], measured, q, time.monotonic()))


@pytest.mark.slow
@pytest.mark.parametrize("stall", [0.05, 0.1])
def test_a_controller_that_is_stopped_for_a_while_publishes_no_jump(
    stall: float, robot: Robot, processes: Processes, node: Any
) -> None:
    cell = Cell(node, robot, start_robot(processes))
    controller = start_controller(processes, *PATIENT, f"rate:={RATE}")
    cell.wait_until_active()
    recorder, stream = Recorder(cell, robot), cell.engage("left")
    home = stream.poses["left"]
    try:
        for _ in range(4):
            begin = len(recorder.commands)
            # The farther one, since a stall that starts over leaves the arm anywhere in between.
            height = cell.tool("left").translation[2]
            goal = max(PLACES, key=lambda place: abs(home.translation[2] + place - height))
            stream.poses["left"] = shifted(home, 0.0, 0.0, goal)
            wait_until(partial(moves_fast, recorder, begin), "the arm moves fast", lambda: cell.states)
            os.kill(controller.pid, signal.SIGSTOP)
            time.sleep(stall)
            os.kill(controller.pid, signal.SIGCONT)
            time.sleep(0.7)
            if cell.state("left_state") != "following":  # a longer stall starts over
                stream.end()
                cell.wait_until_active()
                time.sleep(0.6)
                stream = cell.engage("left")
    finally:
        stream.end()
    assert_no_jump(recorder.commands, robot)


def assert_no_jump(commands: list[Commanded], robot: Robot) -> None:
    """No command asks a joint for more than it may do in the periods since the one before."""
    limit = robot.velocity_limit / RATE
    for before, after in pairwise(commands):
        way = np.abs(after.q - before.q)
        periods = after.number - before.number
        # A gap of more than 100 ms, which a busy machine may make of any stall: the controller starts over at the arms.
        anew = np.abs(after.q - after.measured).max() < SAG and after.t - before.t > 0.1
        assert (way <= periods * limit * (1.0 + 1e-6)).all() or anew, (way / limit).max() / periods


def moves_fast(recorder: Recorder, begin: int) -> bool:
    """Whether commands from index ``begin`` on have become fast."""
    return fastest(recorder.commands[begin:]) > 0.7


def fastest(commands: list[Commanded]) -> float:
    """Largest speed of a joint between two commands [rad/s]."""
    speeds = (
        float(np.abs(after.q - before.q).max() / max(after.number - before.number, 1) * RATE)
        for before, after in pairwise(commands)
    )
    return max(speeds, default=0.0)
