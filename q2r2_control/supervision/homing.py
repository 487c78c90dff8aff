"""The way home, or another way that all arms are led along instead of following targets, and how it ended."""

from __future__ import annotations

import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.joint_homing import ARRIVED, HELD_UP, JointHoming, JointWay
from q2r2_control.supervision.tool_homing import ToolHoming
from q2r2_control.types import Array, Reference


class Homing:
    """Leads the joints of all arms; with ``tools_only`` the tools, where another controller moves the joints.

    Only the supervisor begins a way, once the arms are active and have no targets any more; anybody may end it.
    """

    def __init__(self, robot: Robot, controller: CartesianController, tools_only: bool) -> None:
        self._robot, self._controller, self._tools_only = robot, controller, tools_only
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._way: ToolHoming | JointWay | None = None
        self.outcome: str | None = None  # how the last way home ended, where it did by itself

    @property
    def active(self) -> bool:
        """Whether the arms are led."""
        return self._way is not None

    def begin(self) -> None:
        """Begin the way home."""
        self.outcome = None
        self._way = ToolHoming(self._tools(), self._home) if self._tools_only else self.way_to(self._robot.home)

    def way_to(self, q: Array) -> JointHoming:
        """A way of all joints to ``q`` (nv,) [rad]."""
        return JointHoming(self._robot, self._controller.kept_distances, q)

    def follow(self, way: JointWay) -> None:
        """Lead the joints along ``way`` until it has an outcome."""
        self._way = way

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """What each tool is asked for after another ``dt`` [s] from the ``last`` reference, None: before the first.

        Where joints are led no tool is asked for anything, and the controller is told which joint positions to hold.
        """
        if isinstance(self._way, ToolHoming):
            return self._way.targets(dt)
        if self._way is not None and last is not None:
            self._controller.hold_at(self._way.step(last.q, last.v, dt))
        return dict.fromkeys(self._robot.arms)

    def check(self, reference: Reference) -> str | None:
        """End the way where it has an outcome at the tick's ``reference``; returns that, or None."""
        if self._way is None:
            return None
        outcome = self._way.outcome(self._tools()) if isinstance(self._way, ToolHoming) else self._way.outcome
        if outcome == HELD_UP:
            outcome = f"held up by {' | '.join(reference.report.tightest_pair)}"
        elif outcome == ARRIVED:
            outcome = "at home"
        if outcome:
            self.end()
            self.outcome = outcome
        return outcome

    def end(self) -> None:
        """The arms hold where they come to rest."""
        if self._way is not None and not isinstance(self._way, ToolHoming):
            self._controller.hold_at(None)
        self._way = None

    def hold(self) -> str | None:
        """End the way home as :meth:`end` does. Returns why that is not possible: never, so None."""
        if self.active:
            self.end()
            self.outcome = "the way home was interrupted"
        return None

    def _tools(self) -> dict[str, pin.SE3]:
        return {arm: self._controller.tool_pose(arm) for arm in self._robot.arms}
