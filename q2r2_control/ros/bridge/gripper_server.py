"""The action server of a simulated gripper."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from control_msgs.action import GripperCommand
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

_REACHED = 0.02  # of the stroke
_STALLED_AFTER = 0.3  # without moving by the following [s]
_MOVES = 0.004  # of the stroke
_OUTSIDE = 0.02  # a goal this much beyond the stroke still counts as its end


@dataclass(frozen=True, slots=True)
class Stroke:
    """Positions in the action's messages for the fully open and the closed gripper [m]."""

    open_position: float
    closed_position: float

    def opening(self, position: float) -> float:
        """0 closed .. 1 open, unbounded."""
        return (position - self.closed_position) / (self.open_position - self.closed_position)

    def position(self, opening: float) -> float:
        """The position [m] of an opening 0..1."""
        return self.closed_position + opening * (self.open_position - self.closed_position)


@dataclass(slots=True)
class _Motion:
    handle: ServerGoalHandle
    goal: float  # opening
    seen: float  # opening when it last moved
    moved_at: float  # [s]


class GripperServer:
    """Serves ``topic``. A newer goal aborts the older one; fingers that stop on something have succeeded: stalled.

    A goal's ``max_effort`` is not used: the force is that of the simulated gripper. :meth:`update` works on the goals,
    since a callback that waits would block the node's only thread.
    """

    def __init__(
        self, node: Node, topic: str, stroke: Stroke, command: Callable[[float], None], refuse: Callable[[str], None]
    ) -> None:
        self._stroke, self._command, self._refuse = stroke, command, refuse
        self._motion: _Motion | None = None
        self._newest: ServerGoalHandle | None = None
        self._server = ActionServer(
            node,
            GripperCommand,
            topic,
            execute_callback=lambda _: GripperCommand.Result(),  # each goal gets its own when it ends
            goal_callback=self._check,
            handle_accepted_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def update(self, now: float, opening: float, effort: float) -> None:
        """Go on with the goal at ``now`` [s]: the gripper is open by ``opening`` 0..1 and presses by ``effort`` [N]."""
        if self._newest is not None:
            if self._motion is not None:
                self._finish(self._motion.handle, "abort", opening, effort, reached=False, stalled=False)
            goal = self._stroke.opening(self._newest.request.command.position)
            self._motion = _Motion(self._newest, min(max(goal, 0.0), 1.0), opening, now)
            self._newest = None
            self._command(self._motion.goal)
        motion = self._motion
        if motion is None:
            return
        if abs(opening - motion.seen) > _MOVES:
            motion.seen, motion.moved_at = opening, now
        reached = abs(opening - motion.goal) <= _REACHED
        stalled = not reached and now - motion.moved_at > _STALLED_AFTER
        if motion.handle.is_cancel_requested:
            self._command(opening)
            self._finish(motion.handle, "canceled", opening, effort, reached, stalled)
        elif reached or stalled:
            self._finish(motion.handle, "succeed", opening, effort, reached, stalled)
        else:
            feedback = GripperCommand.Feedback(position=self._stroke.position(opening), effort=effort)
            motion.handle.publish_feedback(feedback)
            return
        self._motion = None

    def _check(self, goal: GripperCommand.Goal) -> GoalResponse:
        position = goal.command.position
        if math.isfinite(position) and -_OUTSIDE <= self._stroke.opening(position) <= 1.0 + _OUTSIDE:
            return GoalResponse.ACCEPT
        ends = sorted((self._stroke.open_position, self._stroke.closed_position))
        self._refuse(f"gripper position {position:g} m; allowed: {ends[0]:g} .. {ends[1]:g}")
        return GoalResponse.REJECT

    def _accept(self, handle: ServerGoalHandle) -> None:
        if self._newest is not None:
            self._end(self._newest, "abort", GripperCommand.Result())
        self._newest = handle

    def _finish(
        self, handle: ServerGoalHandle, outcome: str, opening: float, effort: float, reached: bool, stalled: bool
    ) -> None:
        position = self._stroke.position(opening)
        result = GripperCommand.Result(position=position, effort=effort, reached_goal=reached, stalled=stalled)
        self._end(handle, outcome, result)

    def _end(self, handle: ServerGoalHandle, outcome: str, result: GripperCommand.Result) -> None:
        def conclude(handle: ServerGoalHandle) -> GripperCommand.Result:
            # A goal that is being cancelled can end as canceled only.
            getattr(handle, "canceled" if handle.is_cancel_requested else outcome)()
            return result

        handle.execute(conclude)
