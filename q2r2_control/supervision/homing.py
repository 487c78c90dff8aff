"""The way home, or another way that all arms are led along instead of following targets, and how it ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.joint_homing import JointHoming
from q2r2_control.types import Reference

_LINEAR_SPEED, _ANGULAR_SPEED = 0.1, 0.3  # [m/s], [rad/s]
_ARRIVED, _TURNED = 0.003, 0.01  # [m], [rad]
_PATIENCE = 5.0  # after the targets have arrived [s]


class ToolHoming:
    """Targets on a straight line from where the tools are to where they are at home, all arms at once.

    The QP keeps limits and distances on the way, and the posture's pull brings the elbows home; where it holds the
    tools up the homing ends there.
    """

    def __init__(self, home: Mapping[str, pin.SE3], tool_pose: Callable[[str], pin.SE3]) -> None:
        """``tool_pose``: where the controller's reference has an arm's tool."""
        self._home, self._tool_pose = dict(home), tool_pose
        self._start = {arm: tool_pose(arm) for arm in home}
        self._duration = max(self._needed(arm) for arm in home)
        self._time = 0.0

    def targets(self, dt: float) -> dict[str, pin.SE3 | None]:
        """Where the tools have to be after another ``dt`` [s]."""
        self._time += dt
        share = min(self._time / self._duration, 1.0)
        return {arm: _between(start, self._home[arm], share) for arm, start in self._start.items()}

    @property
    def outcome(self) -> ReasonKind | None:
        """How the homing ended, or None while it goes on."""
        if self._time < self._duration:
            return None
        errors = [self._tool_pose(arm).actInv(home) for arm, home in self._home.items()]
        ways = [(np.linalg.norm(error.translation), np.linalg.norm(pin.log3(error.rotation))) for error in errors]
        if all(way <= _ARRIVED and turn <= _TURNED for way, turn in ways):
            return ReasonKind.HOMING_ARRIVED
        return ReasonKind.HOMING_HELD_UP if self._time > self._duration + _PATIENCE else None

    def _needed(self, arm: str) -> float:
        start, home = self._start[arm], self._home[arm]
        way = float(np.linalg.norm(home.translation - start.translation))
        turn = float(np.linalg.norm(pin.log3(start.rotation.T @ home.rotation)))
        return max(way / _LINEAR_SPEED, turn / _ANGULAR_SPEED, 0.1)


def _between(start: pin.SE3, home: pin.SE3, share: float) -> pin.SE3:
    turn = pin.log3(start.rotation.T @ home.rotation)
    translation = start.translation + share * (home.translation - start.translation)
    return pin.SE3(start.rotation @ pin.exp3(share * turn), translation)


class Homing:
    """Leads the joints of all arms; with ``tools_only`` the tools, where another controller moves the joints.

    Only the supervisor begins a way, once the arms are active and have no targets any more; anybody may end it.
    """

    def __init__(self, robot: Robot, controller: CartesianController, tools_only: bool) -> None:
        self._robot, self._controller, self._tools_only = robot, controller, tools_only
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._way: JointHoming | ToolHoming | None = None
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
            self._way = JointHoming(self._robot, self._controller.kept_distances, self._robot.home)

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """What each tool is asked for after another ``dt`` [s] from the ``last`` reference, None: before the first.

        Where the joints are led, no tool is asked for anything: the controller holds joint positions.
        """
        if isinstance(self._way, ToolHoming):
            return self._way.targets(dt)
        if self._way is not None and last is not None:
            self._controller.hold_at(self._way.step(last.q, last.v, dt))
        return dict.fromkeys(self._robot.arms)

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
            self._controller.hold_at(None)
        self._way = None

    def hold(self) -> Reason | None:
        """End the way home as :meth:`end` does. Returns why that is not possible: never, so None."""
        if self.active:
            self.end()
            self.outcome = Reason(ReasonKind.HOMING_INTERRUPTED)
        return None
