"""One gripper of a kind that users have, asked to open and close."""

from __future__ import annotations

from typing import Any

from control_msgs.action import GripperCommand, ParallelGripperCommand
from rclpy.action import ActionClient
from rclpy.action.client import GoalStatus
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from q2r2_control.config.external import GripperSettings, GripperType
from q2r2_control.ros.bridge.base_node import COMMAND_QOS

_PATIENCE = 10.0  # for a result; after that the gripper counts as silent [s]


class GripperClient:
    """Opens and closes one gripper; nothing here waits.

    ``closed`` is what the gripper is known to be: it changes when a result says so, and a gripper that has stalled on
    something holds it, which is success whatever the status of the goal. A topic gives no result; there it changes with
    the command. Before the first result the gripper counts as open.
    """

    def __init__(self, node: Node, name: str, settings: GripperSettings) -> None:
        self.closed = False
        self.problem: str | None = None
        self._node, self._name, self._settings = node, name, settings
        self._wish: bool | None = None  # closed or not, while a goal is under way
        self._sent = 0.0  # [s]
        self._goals = 0
        kind = settings.action_type
        self._publisher = self._client = None
        if kind is GripperType.FLOAT64_MULTI_ARRAY:
            self._publisher = node.create_publisher(Float64MultiArray, name, COMMAND_QOS)
        else:
            self._action = GripperCommand if kind is GripperType.GRIPPER_COMMAND else ParallelGripperCommand
            self._client = ActionClient(node, self._action, name)

    @property
    def state(self) -> str:
        """One word: open, closed, opening or closing."""
        if self._wish is None:
            return "closed" if self.closed else "open"
        return "closing" if self._wish else "opening"

    def toggle(self, now: float) -> None:
        """Ask for the opposite of what the gripper is, or of what it is about to be."""
        self.command(not (self.closed if self._wish is None else self._wish), now)

    def command(self, close: bool, now: float) -> None:
        """Ask to close or open; a server that is not there is told in ``problem``, and the wish is dropped.

        It is not kept for later, since a gripper that moves when its server comes up would surprise.
        """
        position = self._settings.closed_position if close else self._settings.open_position
        self.problem = None
        if self._publisher is not None:
            self._publisher.publish(Float64MultiArray(data=[position]))
            self.closed = close
            return
        assert self._client is not None
        if not self._client.server_is_ready():
            self.problem = f"no gripper server at {self._name}"
            return
        self._goals += 1
        self._wish, self._sent = close, now
        number = self._goals
        answer = self._client.send_goal_async(self._goal(position))
        answer.add_done_callback(lambda future: self._answered(future.result(), number))

    def check(self, now: float) -> None:
        """Give up a goal that nobody answers."""
        if self._wish is not None and now - self._sent > _PATIENCE:
            self._end(f"no result from {self._name} for {_PATIENCE:g} s")

    def _goal(self, position: float) -> Any:
        goal = self._action.Goal()
        if self._action is GripperCommand:
            goal.command.position = position
            goal.command.max_effort = self._settings.max_effort
        else:
            goal.command.name = [self._settings.joint_name]
            goal.command.position = [position]
            goal.command.effort = [self._settings.max_effort]
        return goal

    def _answered(self, handle: Any, number: int) -> None:
        if number != self._goals:
            return
        if handle is None or not handle.accepted:
            self._end(f"{self._name} refused the goal")
        else:
            handle.get_result_async().add_done_callback(lambda future: self._done(future.result(), number))

    def _done(self, answer: Any, number: int) -> None:
        if number != self._goals or self._wish is None:
            return  # another goal has taken its place
        result = answer.result
        if answer.status == GoalStatus.STATUS_SUCCEEDED or result.stalled or result.reached_goal:
            self.closed = self._wish
            self._end(None)
        else:
            self._end(f"{self._name} ended with status {answer.status}, neither stalled nor at its goal")

    def _end(self, problem: str | None) -> None:
        self._wish, self.problem = None, problem
        self._goals += 1  # whatever still comes of it is late
        if problem is not None:
            self._node.get_logger().warning(problem)
