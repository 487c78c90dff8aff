"""The way home, or another way that all arms are led along instead of following targets, and how it ended."""

from __future__ import annotations

from typing import Protocol

import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.joint_homing import JointHoming
from q2r2_control.supervision.tool_homing import ToolHoming
from q2r2_control.types import Reference


class LedWay(Protocol):
    """A way that all arms are led along; the controller follows as its promises allow."""

    @property
    def outcome(self) -> ReasonKind | None:
        """How it ended, or None while it goes on."""
        ...

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """What each tool is asked for after another ``dt`` [s] from the ``last`` reference, None: before the first."""
        ...

    def end(self) -> None:
        """Lead nothing any more."""
        ...


class LedJoints:
    """Asks no tool for anything: the controller holds the joint positions of a :class:`JointHoming`."""

    def __init__(self, controller: CartesianController, way: JointHoming) -> None:
        self._controller, self._way = controller, way
        self._arms = tuple(controller.robot.arms)

    @property
    def outcome(self) -> ReasonKind | None:
        """See :attr:`LedWay.outcome`."""
        return self._way.outcome

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """See :meth:`LedWay.targets`."""
        if last is not None:
            self._controller.hold_at(self._way.step(last.q, last.v, dt))
        return dict.fromkeys(self._arms)

    def end(self) -> None:
        """See :meth:`LedWay.end`."""
        self._controller.hold_at(None)


class Homing:
    """Leads the joints of all arms; with ``tools_only`` the tools, where another controller moves the joints.

    Only the supervisor begins a way, once the arms are active and have no targets any more; anybody may end it.
    """

    def __init__(self, robot: Robot, controller: CartesianController, tools_only: bool) -> None:
        self._robot, self._controller, self._tools_only = robot, controller, tools_only
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._way: LedWay | None = None
        self.outcome: Reason | None = None  # how the last way home ended, where it did by itself

    @property
    def active(self) -> bool:
        """Whether the arms are led."""
        return self._way is not None

    def begin(self) -> None:
        """Begin the way home."""
        self.outcome = None
        if self._tools_only:
            self._way = ToolHoming(self._home, self._controller.tool_pose)
        else:
            way = JointHoming(self._robot, self._controller.kept_distances, self._robot.home)
            self._way = LedJoints(self._controller, way)

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """See :meth:`LedWay.targets`; no way: nothing is asked for."""
        return dict.fromkeys(self._robot.arms) if self._way is None else self._way.targets(last, dt)

    def check(self, reference: Reference) -> Reason | None:
        """End the way where it has an outcome at the tick's ``reference``; returns that, or None."""
        kind = None if self._way is None else self._way.outcome
        if kind is None:
            return None
        self.end()
        by = {"by": " | ".join(reference.report.tightest_pair)} if kind is ReasonKind.HOMING_HELD_UP else {}
        self.outcome = Reason(kind, by)
        return self.outcome

    def end(self) -> None:
        """The arms hold where they come to rest."""
        if self._way is not None:
            self._way.end()
        self._way = None

    def hold(self) -> Reason | None:
        """End the way home as :meth:`end` does. Returns why that is not possible: never, so None."""
        if self.active:
            self.end()
            self.outcome = Reason(ReasonKind.HOMING_INTERRUPTED)
        return None
