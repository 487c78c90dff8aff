"""Arms whose nodes run apart: the controller, which gets the targets of both, holds both where one node is gone."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

from tests.ros.cockpit import Cockpit

STILL = 0.005  # [rad]


@pytest.mark.alone
def test_a_killed_node_stops_both_arms_and_one_that_its_operator_pauses_its_own(
    domain: int, robot: Robot, processes: Processes
) -> None:
    with spun_node(domain) as node:
        cockpit = Cockpit(node, robot, processes, {}, apart=True)
        left, right = cockpit.left, cockpit.right
        cockpit.rigs.engage()
        left.pause()
        time.sleep(1.0)  # longer than the controller waits for targets
        assert right.state["engaged"]
        assert cockpit.cell.state("right_state") == "following"
        left.engage()

        os.kill(cockpit.arms[0].pid, signal.SIGKILL)
        right.wait(lambda: right.state["state"] == "lost", "the other arm is paused")
        assert "says that targets are not followed any more" in right.state["last_event"]
        rest = cockpit.cell.joints.wait_for_rest()
        right.move((0.0, 0.0, 0.1), 0.4)
        assert np.abs(cockpit.cell.q - rest).max() < STILL
        right.engage()
        right.move((0.0, 0.0, 0.05), 0.4)
        right.wait(lambda: np.abs(cockpit.cell.q - rest).max() > 4.0 * STILL, "a press moves its arm again")
