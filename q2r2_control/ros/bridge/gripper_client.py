"""The client of an arm's gripper, for each ROS interface of :class:`GripperType`."""

from __future__ import annotations

import math
from typing import Any

from control_msgs.action import GripperCommand, ParallelGripperCommand
from rclpy.action import ActionClient
from rclpy.action.client import GoalStatus
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from q2r2_control.config.external import GripperSettings, GripperType
from q2r2_control.ros.base_node import COMMAND_QOS, LATCHED_QOS, BaseNode

_RESULT_TIMEOUT = 10.0  # Longest time to wait for the result of a goal [s].
_ANSWER_TIMEOUT = 1.0  # Longest time to wait for the controller that grants openings [s].
# For a gripper that follows a trigger: shortest time between two goals [s], and smallest change of the opening, as a
# share of the stroke, for which a new goal is sent.
_MOVE_PERIOD, _MOVE_STEP = 0.1, 0.01


def wanted_topic(target_topic: str) -> str:
    """Return the topic on which the sender of an arm's targets requests openings."""
    return f"{target_topic}/wanted_opening"


class OpeningGrants:
    """Requests openings of one arm's gripper from the built-in controller: 0 closed .. 1 fully open.

    It publishes the wanted opening and the last commanded opening. From these, a restarted controller knows where the
    gripper can be, and does not take an old request for a new one.
    """

    def __init__(self, node: BaseNode, controller: str, arm: str, target_topic: str) -> None:
        """Prepare requests to the built-in ``controller``, on a topic beside the arm's ``target_topic``."""
        self._wanted, self._commanded = math.nan, math.nan
        self._answer: tuple[float, float] | None = None  # The wanted and the granted opening.
        self._publisher = node.create_publisher(Float64MultiArray, wanted_topic(target_topic), LATCHED_QOS)
        self._node, self._topic = node, f"{controller}/opening/{arm}"
        node.create_subscription(Float64MultiArray, self._topic, self._on_answer, LATCHED_QOS)

    @property
    def answered(self) -> bool:
        return int(self._node.count_publishers(self._topic)) > 0

    @property
    def granted(self) -> float | None:
        """The opening that may be commanded now, as a step towards the requested opening; None before an answer."""
        return None if self._answer is None or self._answer[0] != self._wanted else self._answer[1]

    def ask(self, opening: float) -> None:
        """Request an opening. The request is valid until the next request."""
        self._wanted = opening
        self._tell()

    def commanded(self, opening: float) -> None:
        self._commanded = opening
        self._tell()

    def _tell(self) -> None:
        self._publisher.publish(Float64MultiArray(data=[self._wanted, self._commanded]))

    def _on_answer(self, message: Float64MultiArray) -> None:
        if len(message.data) == 2 and all(0.0 <= number <= 1.0 for number in message.data):
            self._answer = message.data[0], message.data[1]
        else:
            self._node.drop(self._topic, f"{list(message.data)!s:.60}")


class GripperClient:
    """Opens and closes one gripper. No method waits for an answer.

    ``closed`` is the gripper's known state, False before the first result. If a gripper has stalled, it holds an
    object, and its goal has succeeded whatever the goal's status is. A gripper that takes commands on a topic gives no
    result, so its state changes with the command. With ``grants``, each command goes only as far as the built-in
    controller allows, until the request is fulfilled.
    """

    def __init__(self, node: Node, name: str, settings: GripperSettings, grants: OpeningGrants | None = None) -> None:
        self.closed = False
        self.holds = False  # Whether the gripper has closed on an object, by the result of the last goal.
        self.problem: str | None = None
        self._node, self._name, self._settings, self._grants = node, name, settings, grants
        self._goal_closed: bool | None = None  # Whether the current goal closes the gripper; None without a goal.
        self._position: float | None = None  # The last position that the gripper reported.
        self._sent, self._asked = -math.inf, 1.0  # The last request: its time [s] and its opening.
        self._commanded: float | None = None  # The last commanded opening.
        self._begins = False  # True until the first command for the last request is sent.
        self._commanded_at = -math.inf  # Time of the last command [s].
        self._waits = False  # True while only a part of the requested motion is granted.
        self._closes = False  # Whether the last request is a smaller opening than the previous request.
        self._goals = 0
        self._publisher = self._client = None
        if settings.action_type is GripperType.FLOAT64_MULTI_ARRAY:
            self._publisher = node.create_publisher(Float64MultiArray, name, COMMAND_QOS)
        else:
            simple = settings.action_type is GripperType.GRIPPER_COMMAND
            self._action = GripperCommand if simple else ParallelGripperCommand
            self._client = ActionClient(node, self._action, name)

    @property
    def state(self) -> str:
        if self._goal_closed is None:
            return "closed" if self.closed else "open"
        return "closing" if self._goal_closed else "opening"

    @property
    def opening(self) -> float:
        """The last reported opening: 0 closed .. 1 open; 1 before the first report, -inf if there are no reports."""
        if self._client is None or self._position is None:
            return -math.inf if self._client is None else 1.0
        closed, opened = self._settings.closed_position, self._settings.open_position
        return min(max((self._position - closed) / (opened - closed), 0.0), 1.0)

    def toggle(self, now: float) -> None:
        """Request the opposite of the gripper's state, or of the state to which it moves."""
        closed = self._asked < 0.5 if self._waits else self.closed if self._goal_closed is None else self._goal_closed
        self.command(not closed, now)

    def command(self, close: bool, now: float) -> None:
        self._ask(0.0 if close else 1.0, now)

    def move(self, opening: float, now: float) -> None:
        """Request an opening, 0 closed .. 1 open, if a trigger has moved, at most ten times a second."""
        moved = abs(opening - self._asked) >= _MOVE_STEP or (opening in (0.0, 1.0) and opening != self._asked)
        if moved and not 0.0 <= now - self._sent < _MOVE_PERIOD:
            self._ask(opening, now)

    def _ask(self, opening: float, now: float) -> None:
        """Request an opening. Without a server for the gripper, ``problem`` says so, and the request is dropped."""
        self._closes = opening < self._asked or (opening == self._asked and self._closes)
        self.holds = self.holds and self._closes
        self.problem, self._asked, self._sent, self._waits = None, opening, now, False
        if not self._has_server():
            self.problem = f"no gripper server at {self._name}"
            self._ask_to_stay()
            return
        self._goals += 1  # With a new number, the results of earlier goals are ignored.
        if self._client is not None:
            self._goal_closed = opening < 0.5
        self._begins, self._waits = True, self._grants is not None and self._grants.answered
        if self._grants is not None:
            self._grants.ask(opening)
        if not self._waits:
            self._command(opening, now)

    def _go_on(self, now: float) -> None:
        """Command the granted opening. If the controller has ended or does not answer, end the motion."""
        assert self._grants is not None
        granted = self._grants.granted
        if not self._grants.answered:
            self._give_up("the controller that grants openings has ended")
        elif granted is None:
            if now - self._sent > _ANSWER_TIMEOUT:
                self._give_up("the controller that grants openings does not answer")
        elif self._begins or granted != self._commanded:
            if granted != self._asked and now - self._commanded_at < _MOVE_PERIOD:
                return
            if not self._has_server():
                self._give_up("it has no server any more")
                return
            self._waits = granted != self._asked
            self._command(granted, now)

    def _has_server(self) -> bool:
        if self._publisher is not None:
            return bool(self._publisher.get_subscription_count())
        return bool(self._client and self._client.server_is_ready())

    def _give_up(self, why: str) -> None:
        self._end(f"{self._name} goes no farther: {why}")
        self._ask_to_stay()

    def _ask_to_stay(self) -> None:
        if self._grants is not None and self._commanded is not None:
            self._grants.ask(self._commanded)

    def _command(self, opening: float, now: float) -> None:
        self._commanded, self._commanded_at, self._begins, settings = opening, now, False, self._settings
        if self._grants is not None:
            self._grants.commanded(opening)
        position = (1.0 - opening) * settings.closed_position + opening * settings.open_position
        if self._publisher is not None:
            self._publisher.publish(Float64MultiArray(data=[position]))
            self.closed = self._asked < 0.5
            return
        assert self._client is not None
        self._goals = number = self._goals + 1
        answer = self._client.send_goal_async(
            self._goal(position), feedback_callback=lambda told: self._note(told.feedback)
        )
        answer.add_done_callback(lambda future: self._answered(future.result(), number))

    def check(self, now: float) -> None:
        """Continue with granted openings, and give up a goal whose result does not come in time."""
        if self._waits:
            self._go_on(now)
        elif self._goal_closed is not None and now - self._commanded_at > _RESULT_TIMEOUT:
            self._end(f"no result from {self._name} for {_RESULT_TIMEOUT:g} s")

    def _goal(self, position: float) -> Any:
        goal, effort = self._action.Goal(), self._settings.max_effort
        if self._action is GripperCommand:
            goal.command.position, goal.command.max_effort = position, effort
        else:
            goal.command.name = [self._settings.joint_name]
            goal.command.position, goal.command.effort = [position], [effort]
        return goal

    def _answered(self, handle: Any, number: int) -> None:
        if number != self._goals:
            return
        if handle is None or not handle.accepted:
            self._end(f"{self._name} refused the goal")
        else:
            handle.get_result_async().add_done_callback(lambda future: self._done(future.result(), number))

    def _done(self, answer: Any, number: int) -> None:
        if number != self._goals or self._goal_closed is None:
            return  # Another goal has replaced this goal.
        result = answer.result
        self._note(result)
        if self._waits:
            return  # The gripper still moves to the requested opening.
        if answer.status == GoalStatus.STATUS_SUCCEEDED or result.stalled or result.reached_goal:
            self.closed, self.holds = self._goal_closed, bool(result.stalled) and self._closes
            self._end(None)
        else:
            self._end(f"{self._name} ended with status {answer.status}, neither stalled nor at its goal")

    def _note(self, told: Any) -> None:
        if self._action is GripperCommand:
            self._position = float(told.position)
        elif len(told.state.position):
            self._position = float(told.state.position[0])

    def _end(self, problem: str | None) -> None:
        self._goal_closed, self.problem, self._waits = None, problem, False
        self._goals += 1  # With a new number, later answers to this goal are ignored.
        if problem is not None:
            self._node.get_logger().warning(problem)
