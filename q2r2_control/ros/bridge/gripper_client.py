"""The client of an arm's gripper, for the kinds of grippers in use."""

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

_RESULT_TIMEOUT = 10.0  # of a goal [s]
_ANSWER_TIMEOUT = 1.0  # of the controller that grants openings [s]
_MOVE_PERIOD, _MOVE_STEP = 0.1, 0.01  # between two goals of a gripper that follows a trigger [s], of the stroke


def wanted_topic(target_topic: str) -> str:
    """Where the sender of an arm's targets asks for openings."""
    return f"{target_topic}/wanted_opening"


class OpeningGrants:
    """One arm's gripper; openings are 0 closed .. 1 fully open.

    It tells the wanted opening, and the one that was commanded last. A controller that starts anew then knows where the
    gripper may be, and does not take an old wish for a new one.
    """

    def __init__(self, node: BaseNode, controller: str, arm: str, target_topic: str) -> None:
        """``controller``: the built-in one's name; ``target_topic``: where the arm's targets go."""
        self._wanted, self._commanded = math.nan, math.nan
        self._answer: tuple[float, float] | None = None  # what was wanted, and what is granted of it
        self._publisher = node.create_publisher(Float64MultiArray, wanted_topic(target_topic), LATCHED_QOS)
        self._node, self._topic = node, f"{controller}/opening/{arm}"
        node.create_subscription(Float64MultiArray, self._topic, self._on_answer, LATCHED_QOS)

    @property
    def answered(self) -> bool:
        return int(self._node.count_publishers(self._topic)) > 0

    @property
    def granted(self) -> float | None:
        """The opening that may be commanded now, on the way to the one that was asked for; None: not answered yet."""
        return None if self._answer is None or self._answer[0] != self._wanted else self._answer[1]

    def ask(self, opening: float) -> None:
        """Ask for an opening, until another one is asked for."""
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
    """Opens and closes one gripper; no call waits.

    ``closed`` is its known state, open before the first result. A gripper that has stalled holds an object, which is
    success whatever the status of the goal. A topic gives no result: there the state changes with the command. With
    ``grants`` it is commanded no farther than the built-in controller allows, until it is where it was asked to be.
    """

    def __init__(self, node: Node, name: str, settings: GripperSettings, grants: OpeningGrants | None = None) -> None:
        self.closed = False
        self.holds = False  # closed on something, as the result of the last goal says
        self.problem: str | None = None
        self._node, self._name, self._settings, self._grants = node, name, settings, grants
        self._goal_closed: bool | None = None  # closed or not, while a goal is under way
        self._position: float | None = None  # that the gripper told last
        self._sent, self._asked = -math.inf, 1.0  # what was asked for last: when [s], and the opening
        self._commanded: float | None = None  # the last opening that was commanded
        self._begins = False  # nothing was commanded yet of what was asked for
        self._commanded_at = -math.inf  # [s]
        self._waits = False  # for more to be granted
        self._closes = False  # it is a smaller one than that of the goal before
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
        """0 closed .. 1 open, as the gripper told with its last goal; 1 before the first, -inf where it cannot tell."""
        if self._client is None or self._position is None:
            return -math.inf if self._client is None else 1.0
        closed, opened = self._settings.closed_position, self._settings.open_position
        return min(max((self._position - closed) / (opened - closed), 0.0), 1.0)

    def toggle(self, now: float) -> None:
        """Ask for the opposite of the gripper's state, or of the state that it is moving to."""
        closed = self._asked < 0.5 if self._waits else self.closed if self._goal_closed is None else self._goal_closed
        self.command(not closed, now)

    def command(self, close: bool, now: float) -> None:
        self._ask(0.0 if close else 1.0, now)

    def move(self, opening: float, now: float) -> None:
        """Ask for an opening, 0 closed .. 1 open, as often as a trigger moves: ten times a second at most."""
        moved = abs(opening - self._asked) >= _MOVE_STEP or (opening in (0.0, 1.0) and opening != self._asked)
        if moved and not 0.0 <= now - self._sent < _MOVE_PERIOD:
            self._ask(opening, now)

    def _ask(self, opening: float, now: float) -> None:
        """Request an opening from the gripper. Without an action server ``problem`` says so, and nothing is kept."""
        self._closes = opening < self._asked or (opening == self._asked and self._closes)
        self.holds = self.holds and self._closes
        self.problem, self._asked, self._sent, self._waits = None, opening, now, False
        if not self._has_server():
            self.problem = f"no gripper server at {self._name}"
            self._ask_to_stay()
            return
        self._goals += 1  # what goals before this one lead to is not asked for any more
        if self._client is not None:
            self._goal_closed = opening < 0.5
        self._begins, self._waits = True, self._grants is not None and self._grants.answered
        if self._grants is not None:
            self._grants.ask(opening)
        if not self._waits:
            self._command(opening, now)

    def _go_on(self, now: float) -> None:
        """Command what is granted. A gripper goes no farther because its controller has ended."""
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
        """Go on with what is granted; give up a goal that is not answered in time."""
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
            return  # another goal has taken its place
        result = answer.result
        self._note(result)
        if self._waits:
            return  # on the way to where it was asked to be
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
        self._goals += 1  # later answers to this goal are ignored
        if problem is not None:
            self._node.get_logger().warning(problem)
