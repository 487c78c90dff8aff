"""The way home, along which all arms are led instead of following targets; and where no run may begin at home."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import islice, pairwise
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.watched_pairs import PairsAhead
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.kept_distances import kept_distances, too_close_at_home
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import joints_that_cannot_hold
from q2r2_control.robot.unchecked import unchecked_faults
from q2r2_control.supervision.target_stream import apart
from q2r2_control.types import Array, Reference

_SPEED = 0.3  # of the fastest joint [rad/s]
_SLOWED, _WAITED = 0.09, 0.12  # by how much the arms lag behind where the way is slowed, and where it waits [rad]
_POINT_REACHED, _GOAL_REACHED = 0.1, 0.003  # how near the arms come to a way point, and to the goal [rad]
_LONGEST_WAIT, _PROGRESS = 3.0, 1e-3  # without progress of so much [s], [rad]
_AT_REST = 0.02  # [rad/s]
_ROOM = 0.003  # more than what a pair keeps [m]
_STOP = 0.05  # in which joints of that speed stop, if their limit is 6 rad/s^2 or more [s]
_SAMPLE = 0.05  # between two samples of a way [rad]
_SAMPLES_A_TICK = 2
_RANDOM_WAYS = 300
_SPREAD = 0.6  # of random way points [rad]
_INSIDE = 0.02  # of joint limits [rad]
_NARROWEST = 1e-3  # range of a joint in which a home can be written down [rad or m]


class HomingStep(NamedTuple):
    """One tick of a way home."""

    joints: Array | None  # (nv,) where arms without a target shall be [rad]; None: where they rest
    targets: dict[str, pin.SE3 | None]  # of tools; an arm that is missing has none


class WayHome(Protocol):
    """Leads all arms home, from where it was made on."""

    @property
    def outcome(self) -> ReasonKind | None:
        """How it ended, or None while it goes on."""

    def step(self, q: Array, v: Array, dt: float) -> HomingStep:
        """Where the arms shall be in ``dt`` [s], with the reference at ``q``, ``v`` (nv,)."""


class JointHoming:
    """Leads all joints to a goal, from where they come to rest."""

    def __init__(self, robot: Robot, look: Callable[[], PairsAhead], goal: Array, straight: bool = False) -> None:
        """``look``: see :meth:`CartesianController.pairs_ahead`; ``goal`` (nv,) [rad].

        ``straight``: no way but the straight one is gone.
        """
        self._robot, self._look, self._goal, self._straight = robot, look, goal, straight
        self._search: Iterator[list[Array] | None] | None = None
        self._points: list[Array] | None = None  # still to be reached, the goal last
        self._at = self._leg = self._goal  # where the joints shall be, and where the leg to the next point began
        self._share = 0.0  # of the leg
        self._least_left = np.inf  # of the way to the next point, of the joint that has the most [rad]
        self._waited = 0.0  # without progress [s]
        self.outcome: ReasonKind | None = None  # how it ended

    def step(self, q: Array, v: Array, dt: float) -> HomingStep:
        """See :class:`WayHome`."""
        if self._search is None:
            if float(np.abs(v).max()) > _AT_REST:
                return HomingStep(None, {})
            self._distances, kept = self._look()
            # A pair that has less room where the way begins needs no more than that.
            self._needed = np.minimum(kept + _ROOM, self._distances(q) - 1e-4)
            self._at = self._leg = q.copy()
            self._search = self._ways(self._at)
        if self._points is None:
            found = (way for way in islice(self._search, _SAMPLES_A_TICK) if way is not None)
            self._points = next(found, None)
            if self._points == []:
                self.outcome = ReasonKind.HOMING_NO_WAY
        elif self._points:
            self._go(self._points, q, dt)
        return HomingStep(self._at, {})

    def _go(self, points: list[Array], q: Array, dt: float) -> None:
        goal, last = points[0], len(points) == 1
        way = goal - self._leg
        lag = float(np.abs(self._at - q).max())
        rate = min(max((_WAITED - lag) / (_WAITED - _SLOWED), 0.0), 1.0)
        self._share = min(self._share + rate * dt * _SPEED / max(float(np.abs(way).max()), 1e-6), 1.0)
        self._at = self._leg + self._share * way
        left = float(np.abs(goal - q).max())
        if left < self._least_left - _PROGRESS:
            self._least_left, self._waited = left, 0.0
        else:
            self._waited += dt
        if self._share == 1.0 and left < (_GOAL_REACHED if last else _POINT_REACHED):
            points.pop(0)
            self._leg, self._share = goal, 0.0
            self._least_left, self._waited = np.inf, 0.0
            self.outcome = ReasonKind.HOMING_ARRIVED if last else None
        elif self._waited > _LONGEST_WAIT:
            self.outcome = ReasonKind.HOMING_HELD_UP

    def _ways(self, start: Array) -> Iterator[list[Array] | None]:
        """Samples one way after the other: None for each sample, the points of a free way, [] after the last."""
        for between in self._candidates(start):
            points = [start, *between, self._goal]
            for posture in _samples(points):
                yield None
                if (self._distances(posture) < self._needed).any():
                    break
            else:
                yield points[1:]
                return
        yield []

    def _candidates(self, start: Array) -> Iterator[tuple[Array, ...]]:
        """Way points between ``start`` and the goal."""
        robot, goal = self._robot, self._goal
        yield ()
        if self._straight:
            return
        for arm in robot.arms.values():
            first = start.copy()
            first[arm.joints] = goal[arm.joints]
            yield (first,)
        random = np.random.default_rng(0)  # the same way at every time
        for number in range(_RANDOM_WAYS):
            middle = goal if number % 2 else start + random.uniform(0.2, 0.8) * (goal - start)
            point = middle + random.normal(0.0, _SPREAD, len(goal))
            yield (np.clip(point, robot.position_lower + _INSIDE, robot.position_upper - _INSIDE),)


def _samples(points: list[Array]) -> Iterator[Array]:
    """Postures along a way; the end of each leg first, since a bad way point is not worth the way there."""
    for a, b in pairwise(points):
        count = max(int(np.abs(b - a).max() / _SAMPLE), 1)
        for share in (1.0, *(i / count for i in range(1, count))):
            yield a + share * (b - a)


_LINEAR_SPEED, _ANGULAR_SPEED = 0.1, 0.3  # [m/s], [rad/s]
_ARRIVED, _TURNED = 0.003, 0.01  # [m], [rad]
_PATIENCE = 5.0  # after the targets have arrived [s]


class ToolHoming:
    """Targets on straight lines home for all tools at once; where the QP holds one up, the homing ends there."""

    def __init__(self, home: Mapping[str, pin.SE3], tool_pose: Callable[[str], pin.SE3]) -> None:
        """``tool_pose``: where the controller's reference has an arm's tool."""
        self._home, self._tool_pose = dict(home), tool_pose
        self._start = {arm: tool_pose(arm) for arm in home}
        ways = [apart(start, home[arm]) for arm, start in self._start.items()]
        self._duration = max(max(way / _LINEAR_SPEED, turn / _ANGULAR_SPEED, 0.1) for way, turn in ways)
        self._time = 0.0

    def step(self, q: Array, v: Array, dt: float) -> HomingStep:
        """See :class:`WayHome`."""
        self._time += dt
        share = min(self._time / self._duration, 1.0)
        targets: dict[str, pin.SE3 | None] = {}
        for arm, start in self._start.items():
            way = self._home[arm].translation - start.translation
            turn = pin.log3(start.rotation.T @ self._home[arm].rotation)
            targets[arm] = pin.SE3(start.rotation @ pin.exp3(share * turn), start.translation + share * way)
        return HomingStep(None, targets)

    @property
    def outcome(self) -> ReasonKind | None:
        """See :class:`WayHome`."""
        if self._time < self._duration:
            return None
        errors = [apart(self._tool_pose(arm), home) for arm, home in self._home.items()]
        if all(way <= _ARRIVED and turn <= _TURNED for way, turn in errors):
            return ReasonKind.HOMING_ARRIVED
        return ReasonKind.HOMING_HELD_UP if self._time > self._duration + _PATIENCE else None


class Homing:
    """Leads the joints of all arms; with ``tools_only`` the tools, where another controller moves the joints."""

    def __init__(self, robot: Robot, controller: CartesianController, tools_only: bool) -> None:
        self._robot, self._controller, self._tools_only = robot, controller, tools_only
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._way: WayHome | None = None
        self.outcome: Reason | None = None  # how the last way home ended, where it did by itself

    @property
    def active(self) -> bool:
        return self._way is not None

    def begin(self, goal: Array | None = None) -> None:
        """Begin the way home, or the straight way of all joints to another ``goal`` (nv,) [rad]."""
        self.outcome = None
        if goal is None and self._tools_only:
            self._way = ToolHoming(self._home, self._controller.tool_pose)
        else:
            to, straight = (self._robot.home, False) if goal is None else (goal, True)
            self._way = JointHoming(self._robot, partial(self._controller.pairs_ahead, _STOP), to, straight)

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """The target of each tool in ``dt`` [s], from the ``last`` reference: none where joints are led."""
        if self._way is None or last is None:
            return dict.fromkeys(self._robot.arms)
        step = self._way.step(last.q, last.v, dt)
        self._controller.hold_at(step.joints)
        return dict.fromkeys(self._robot.arms) | step.targets

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
        """End the way home, and say so in :attr:`outcome`. Returns why that is not possible: never, so None."""
        if self.active:
            self.end()
            self.outcome = Reason(ReasonKind.HOMING_INTERRUPTED)
        return None


def preflight_faults(
    robot: Robot, settings: ControllerSettings, controller: CartesianController | None
) -> tuple[str, ...]:
    """One line for each reason why ``robot`` should not start at home; empty for a cell that may run.

    Every link that weighs something needs a shape, unless the cell names it. Position limits are checked with their
    margin, gravity against torque limits, and every monitored pair against the distance that it keeps. The
    ``controller`` has to know a certified stop at home, where it is left reset. None where no controller is about to
    move the arms: a stop of arms at rest keeps all apart where the distances are kept.
    """
    lower, upper = robot.position_lower + settings.position_margin, robot.position_upper - settings.position_margin
    change = "to change: control.position_margin, or a fixed joint in the model"
    faults = unchecked_faults(robot)
    faults += [
        f"{name}: position_margin leaves {max(left, 0.0):g} rad of its range; {change}"
        for name, left in zip(robot.joint_names, upper - lower, strict=True)
        if left < _NARROWEST
    ]
    faults += [
        f"home: {name} = {q:g}; allowed: {least:g} .. {most:g} rad, position_margin included"
        for name, q, least, most in zip(robot.joint_names, robot.home, lower, upper, strict=True)
        if not least <= q <= most
    ]
    faults += [
        f"home: {name} needs {needed:.1f} Nm against gravity alone; allowed: its torque limit, {limit:g} Nm; "
        "to change: another home, or the model's torque limits and masses"
        for name, (needed, limit) in joints_that_cannot_hold(robot, robot.home).items()
    ]
    too_close = too_close_at_home(robot, kept_distances(robot, settings), remedies=True)
    faults += too_close
    if controller is not None and not too_close:  # a pair that is too close leaves no certificate, and says more
        controller.reset(robot.home)
        report = controller.step({}, controller.settings.max_substep).report  # every arm holds
        controller.reset(robot.home)
        if not report.certified:
            tightest = (
                f"{' | '.join(report.tightest_pair)}, {1e3 * report.margin:.1f} mm farther apart than it has to be"
            )
            faults.append(f"home: the controller knows no certified stop from here; tightest pair: {tightest}")
    return tuple(faults)
