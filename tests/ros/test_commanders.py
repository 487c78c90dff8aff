"""If another program commands the arms, or a receiver stands still, both arms stop. The fault names its cause."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from q2r2_control import Robot
from q2r2_control.ros.reasons import RosReason
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()

from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.events import ReasonKind
from q2r2_control.ros.base_node import COMMAND_QOS
from tests.ros.cell import NODE_RATE, PATIENT, Cell, start_controller, start_robot
from tests.ros.processes import wait_until

pytestmark = pytest.mark.alone

TOPIC = "/joint_trajectory"
# On a busy machine, it may take long until a standing arm is found. Meanwhile its deviation must not be a fault.
LONG = "deviation_time:=8.0", "max_deviation:=1.0"


class Driven(Cell):
    """A cell whose arms both follow."""

    def __init__(self, node: Any, robot: Robot, *processes: Any) -> None:
        super().__init__(node, robot, *processes)
        self.wait_until_active()

    def wait_for_fault(self, kind: ReasonKind) -> str:
        """Wait until the controller reports this fault and commands nothing. Return its sentence."""
        wait_until(lambda: self.state("kind") == kind, f"it tells {kind}", lambda: self.states)
        wait_until(lambda: self.state("phase") in ("stopped", "inactive"), "the arms rest", lambda: self.states)
        return str(self.state("message"))


@pytest.fixture
def driven(node: Any, processes: Processes, robot: Robot) -> Iterator[Driven]:
    made = Driven(node, robot, start_robot(processes), start_controller(processes, *PATIENT))
    yield made
    made.end_streams()


def here(cell: Cell) -> JointTrajectory:
    """Return a command that moves nothing."""
    point = JointTrajectoryPoint(positions=cell.q.tolist())
    return JointTrajectory(joint_names=list(cell.robot.joint_names), points=[point])


def test_a_second_publisher_of_commands_stops_both_arms_and_is_named(driven: Driven) -> None:
    driven.engage("left", "right")
    long = 3.0 * NODE_RATE  # After this number of commands, all earlier publishers are discovered.
    wait_until(lambda: driven.state("sent")[TOPIC] > long, "it has driven for some seconds")
    second = driven.node.create_publisher(JointTrajectory, TOPIC, 1)
    found = driven.wait_for_fault(RosReason.OTHER_COMMANDER)
    # The graph may know a publisher before it knows the name of its node. The arms do not wait for the name.
    assert found.startswith(("/test commands the arms", "a node not known yet commands the arms")), found
    assert "on /joint_trajectory" in found
    assert {driven.state(f"{arm}_state") for arm in driven.robot.arms} == {"stopped"}
    driven.end_streams()

    # The second publisher is silent now. After a reset, the controller commands again, and still listens to the topic.
    assert driven.call("/cartesian_controller/reset").success
    wait_until(lambda: driven.state("phase") == "active", "it is active again", lambda: driven.states)
    driven.engage("left", "right")
    second.publish(here(driven))
    assert "/test commands the arms" in driven.wait_for_fault(RosReason.OTHER_COMMANDER)
    driven.end_streams()

    timer = driven.node.create_timer(0.02, lambda: second.publish(here(driven)))
    wait_until(lambda: not driven.call("/cartesian_controller/reset").success, "no reset while the other commands")
    driven.node.destroy_timer(timer)
    wait_until(lambda: driven.call("/cartesian_controller/reset").success, "a reset when it has ceased")


def test_if_a_receiver_stands_still_while_joint_states_come_both_arms_stop_and_the_receiver_is_named(
    node: Any, processes: Processes, robot: Robot
) -> None:
    """This test is the receiver. It acknowledges all commands, and passes them on until it stands still."""
    passes, onward = [True], node.create_publisher(JointTrajectory, TOPIC, COMMAND_QOS)
    node.create_subscription(
        JointTrajectory, "/asked", lambda message: onward.publish(message) if passes[0] else None, COMMAND_QOS
    )
    controller = start_controller(processes, *PATIENT, *LONG, "output_topic:=/asked")
    cell = Driven(node, robot, start_robot(processes), controller)
    stream = cell.engage("left", "right")
    stream.move("left", (0.0, 0.0, 0.05))
    passes[0] = False
    stream.move("left", (0.0, 0.0, 0.2))
    said = "the left arm's controller /test stands still"
    wait_until(lambda: said in cell.state("message"), "it is told", lambda: cell.states)
    wait_until(lambda: cell.state("phase") == "active", "the controller is where the arms are", lambda: cell.states)
    assert [cell.state(f"{arm}_state") for arm in robot.arms] == ["holding", "holding"]
    cell.end_streams()
