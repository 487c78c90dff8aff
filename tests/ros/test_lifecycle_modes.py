"""Controller and robot as managed nodes where the arms are commanded speeds or torques."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("lifecycle_msgs", reason="needs lifecycle_msgs")

from lifecycle_msgs.msg import Transition

from tests.ros.cell import PATIENT, SOFT, changed_cell, start_controller, start_robot
from tests.ros.managed import STILL, Managed
from tests.ros.waiting import wait_until

pytestmark = pytest.mark.alone


@pytest.mark.parametrize("output", ["velocity", "torque"])
def test_arms_that_are_commanded_speeds_or_torques_are_left_at_rest_and_taken_over(
    domain: int, processes: Processes, robot: Robot, output: str, tmp_path: Path
) -> None:
    config = changed_cell(tmp_path, impedance=SOFT)
    with spun_node(domain) as node:
        controller = start_controller(processes, *PATIENT, f"output:={output}", config=config)
        cell = Managed(node, robot, start_robot(processes), controller)
        cell.wait_until_active()
        stream = cell.engage("left")
        stream.move("left", (0.0, 0.0, 0.1))
        assert cell.ask(Transition.TRANSITION_DEACTIVATE)
        stream.end()
        time.sleep(0.5)
        at_rest = cell.q.copy()
        time.sleep(0.5)
        assert np.abs(cell.q - at_rest).max() < STILL
        cell.forget()
        assert cell.ask(Transition.TRANSITION_ACTIVATE)
        time.sleep(0.5)
        assert np.abs(np.array(cell.postures) - at_rest).max() < 2.0 * STILL
        before = cell.tool("left").translation
        stream = cell.engage("left")
        stream.move("left", (0.0, 0.0, 0.05))
        wait_until(lambda: cell.tool("left").translation[2] - before[2] > 0.03, "the arm follows again")
        stream.end()
