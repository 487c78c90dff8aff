"""Recipes for those who come from Quest2ROS2: its arm nodes with our controller, its SimulationInput with our nodes.

Topics, frames, rates and behaviour of its nodes are played here as they are by default. The other way round, our nodes
with the controller that it drives, is in ``test_readme`` and ``test_presets``.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import pinocchio as pin
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs quest2ros: q2r2 ros build-interfaces")

from geometry_msgs.msg import PoseStamped

from q2r2_control.ros.bridge.messages import stamped_pose
from tests.ros.arm_rig import ArmRig
from tests.ros.cell import PATIENT, Cell, shifted, start_controller, start_robot
from tests.ros.waiting import wait_until

TOPIC = "/bh_robot/{arm}_arm_clik_controller/target_frame"
FRAME = "bh_robot_base"
RATE = 75.0  # of the headset, at which its nodes publish [Hz]
NEAR = 4e-3  # the simulated arms sag a little [m]


class TheirArmNodes:
    """Both: enabled at once, a target for each sample of a hand, none while paused, and each restart anchors anew."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._made = {
            arm: cell.node.create_publisher(PoseStamped, TOPIC.format(arm=arm), 10) for arm in cell.robot.arms
        }
        self.moved = (0.0, 0.0, 0.0)  # both hands, since the anchors
        self._anchors: dict[str, pin.SE3] = {}
        self.restart()
        cell.node.create_timer(1.0 / RATE, self._send)

    def pause(self) -> None:
        self._anchors = {}

    def restart(self) -> None:
        self.moved = (0.0, 0.0, 0.0)
        self._anchors = {arm: self._cell.tool(arm) for arm in self._made}

    def move(self, y: float) -> None:
        """Move the hands sidewards at 0.1 m/s."""
        began = time.monotonic()
        while (share := (time.monotonic() - began) * 0.1 / abs(y)) < 1.0:
            self.moved = (0.0, share * y, 0.0)
            time.sleep(0.5 / RATE)
        self.moved = (0.0, y, 0.0)

    def goal(self, arm: str) -> pin.SE3:
        return shifted(self._anchors[arm], *self.moved)

    def _send(self) -> None:
        for arm in self._anchors:
            self._made[arm].publish(stamped_pose(self.goal(arm), FRAME, time.time()))


def arrives(cell: Cell, nodes: TheirArmNodes) -> None:
    for arm in cell.robot.arms:
        wait_until(partial(is_near, cell, arm, nodes.goal(arm)), f"{arm} is where its node asks")


def is_near(cell: Cell, arm: str, goal: pin.SE3) -> bool:
    return float(abs(cell.tool(arm).translation - goal.translation).max()) < NEAR


@pytest.mark.alone
def test_arm_nodes_of_quest2ros2_move_the_arms_through_our_controller(
    node: Any, robot: Robot, processes: Processes
) -> None:
    given = [
        f"{arm}.{name}:={value}"
        for arm in robot.arms
        for name, value in (("target_topic", TOPIC.format(arm=arm)), ("target_frame_id", FRAME))
    ]
    cell = Cell(node, robot, start_robot(processes), start_controller(processes, *PATIENT, *given), targets=TOPIC)
    cell.wait_until_active()
    nodes = TheirArmNodes(cell)
    wait_until(lambda: cell.state("left_state") == "following", "streams that begin at the tools are followed")
    nodes.move(0.05)
    arrives(cell, nodes)
    nodes.pause()
    wait_until(lambda: cell.state("left_state") != "following", "arms without targets hold")
    nodes.restart()
    wait_until(lambda: cell.state("left_state") == "following", "the next stream is followed too")
    nodes.move(-0.05)
    arrives(cell, nodes)


def test_a_simulation_input_that_holds_the_lower_button_from_its_first_message_is_told_of(
    node: Any, processes: Processes
) -> None:
    rig = ArmRig(node)
    rig.lower = True
    rig.start(processes)
    rig.wait(lambda: rig.state["last_event_kind"] == "controls_held", "is told")
    assert not rig.state["engaged"]
    rig.lower = False
    rig.engage()
