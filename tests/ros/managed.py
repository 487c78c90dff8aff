"""A cell of ROS nodes whose lifecycle states are asked for and changed."""

from __future__ import annotations

import time
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control import Robot
from q2r2_control.ros.base_node import STREAM_QOS
from tests.ros.cell import Cell
from tests.ros.waiting import wait_until

STILL = 5e-3  # [rad]


class Managed(Cell):
    """A cell whose nodes' states can be changed, and the joint commands that come."""

    def __init__(self, node: Any, robot: Robot, *processes: Any) -> None:
        super().__init__(node, robot, *processes)
        self.commands: list[JointTrajectory] = []
        node.create_subscription(JointTrajectory, "/joint_trajectory", self.commands.append, STREAM_QOS)
        self.commander = node.create_publisher(JointTrajectory, "/joint_trajectory", 1)
        self._clients = {
            name: (
                node.create_client(ChangeState, f"/{name}/change_state"),
                node.create_client(GetState, f"/{name}/get_state"),
            )
            for name in ("cartesian_controller", "mujoco_robot")
        }

    def ask(self, transition: int, name: str = "cartesian_controller") -> bool:
        """Whether the node says that it did it."""
        change = self._clients[name][0]
        wait_until(change.service_is_ready, "the lifecycle's services are there")
        future = change.call_async(ChangeState.Request(transition=Transition(id=transition)))
        wait_until(future.done, "the transition is answered")
        return bool(future.result().success)

    def lifecycle(self, name: str = "cartesian_controller") -> str:
        future = self._clients[name][1].call_async(GetState.Request())
        wait_until(future.done, "the state is answered")
        return str(future.result().current_state.label)

    def command(self, q: Any) -> None:
        point = JointTrajectoryPoint(positions=[float(value) for value in q])
        self.commander.publish(JointTrajectory(joint_names=list(self.robot.joint_names), points=[point]))

    def move_by_another(self, q: Any, seconds: float = 1.0) -> None:
        """Joint commands of another node to ``q`` [rad], evenly."""
        start, began = self.q.copy(), time.monotonic()
        while (share := (time.monotonic() - began) / seconds) < 1.5:
            self.command(start + min(share, 1.0) * (q - start))
            time.sleep(0.01)
