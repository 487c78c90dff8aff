"""Move all arms to their home posture, or to another posture, instead of following targets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import islice, pairwise
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.control.watched_pairs import PairsAhead
from q2r2_control.events import CommonReason, Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.target_stream import apart
from q2r2_control.types import Array, Reference

_SPEED = 0.3  # Speed of the fastest joint [rad/s].
# If an arm lags by more than the first angle, the setpoint moves more slowly. If it lags by the second one, the
# setpoint waits [rad].
_SLOWED, _WAITED = 0.09, 0.12
_POINT_REACHED, _GOAL_REACHED = 0.1, 0.003  # A waypoint, and the goal, count as reached at these distances [rad].
# Homing ends if the arms come nearer by less than _PROGRESS [rad] within _LONGEST_WAIT [s].
_LONGEST_WAIT, _PROGRESS = 3.0, 1e-3
_AT_REST = 0.02  # The arms are at rest if no joint is faster than this [rad/s].
# On a planned path, each pair is farther apart than its required distance by at least this [m].
_EXTRA_DISTANCE = 0.003
_STOP = 0.05  # Joints at _SPEED stop within this time if their acceleration limit is at least 6 rad/s^2 [s].
_SAMPLE = 0.05  # A path is checked at postures that are this far from each other [rad].
_SAMPLES_A_TICK = 2
_RANDOM_PATHS = 300
_SPREAD = 0.6  # Standard deviation of random waypoints [rad].
_INSIDE = 0.02  # Least distance of random waypoints from joint limits [rad].


class HomingStep(NamedTuple):
    """The setpoints of one tick of the motion home."""

    joints: Array | None  # Joint setpoint of arms without a target (nv,) [rad]; None lets them stay where they rest.
    targets: dict[str, pin.SE3 | None]  # Targets of the tools by arm, in the world frame. A missing arm has no target.


class WayHome(Protocol):
    """Moves all arms home, from the posture that they had when this instance was created."""

    @property
    def outcome(self) -> ReasonKind | None:
        """The result of the motion home; None while the motion continues."""

    def step(self, q: Array, v: Array, dt: float) -> HomingStep:
        """Return the setpoints for the next ``dt`` [s].

        Args:
            q: Joint positions of the reference (nv,) [rad].
            v: Joint velocities of the reference (nv,) [rad/s].
            dt: Duration of the tick [s].
        """


class JointHoming:
    """Moves all joints to a goal. It waits until they rest, and then looks for a path without collisions."""

    def __init__(self, robot: Robot, look: Callable[[], PairsAhead], goal: Array, straight: bool = False) -> None:
        """Prepare the motion to ``goal`` (nv,) [rad].

        Args:
            robot: The robot.
            look: See :meth:`CartesianController.pairs_ahead`.
            goal: The posture at the end (nv,) [rad].
            straight: True if only the straight path in joint space may be taken.
        """
        self._robot, self._look, self._goal, self._straight = robot, look, goal, straight
        self._search: Iterator[list[Array] | None] | None = None
        # Waypoints that are still to be reached. The goal is the last one. None until a path has been found.
        self._points: list[Array] | None = None
        self._at = self._leg = self._goal  # The setpoint, and the beginning of the leg to the next waypoint.
        self._share = 0.0  # Share of the leg that the setpoint has covered.
        # The smallest value so far of the distance between the next waypoint and the farthest joint [rad].
        self._least_left = np.inf
        self._waited = 0.0  # Time without progress [s].
        self.outcome: ReasonKind | None = None  # How the motion ended; None while the motion continues.

    def step(self, q: Array, v: Array, dt: float) -> HomingStep:
        """See :class:`WayHome`."""
        if self._search is None:
            if float(np.abs(v).max()) > _AT_REST:
                return HomingStep(None, {})
            self._distances, kept = self._look()
            # If a pair is closer than ``kept + _EXTRA_DISTANCE`` at the start, it may stay as close as at the start.
            self._needed = np.minimum(kept + _EXTRA_DISTANCE, self._distances(q) - 1e-4)
            self._at = self._leg = q.copy()
            self._search = self._check_paths(self._at)
        if self._points is None:
            found = (path for path in islice(self._search, _SAMPLES_A_TICK) if path is not None)
            self._points = next(found, None)
            if self._points == []:
                self.outcome = CommonReason.HOMING_NO_WAY
        elif self._points:
            self._go(self._points, q, dt)
        return HomingStep(self._at, {})

    def _go(self, points: list[Array], q: Array, dt: float) -> None:
        goal, last = points[0], len(points) == 1
        displacement = goal - self._leg
        lag = float(np.abs(self._at - q).max())
        rate = min(max((_WAITED - lag) / (_WAITED - _SLOWED), 0.0), 1.0)
        self._share = min(self._share + rate * dt * _SPEED / max(float(np.abs(displacement).max()), 1e-6), 1.0)
        self._at = self._leg + self._share * displacement
        left = float(np.abs(goal - q).max())
        if left < self._least_left - _PROGRESS:
            self._least_left, self._waited = left, 0.0
        else:
            self._waited += dt
        if self._share == 1.0 and left < (_GOAL_REACHED if last else _POINT_REACHED):
            points.pop(0)
            self._leg, self._share = goal, 0.0
            self._least_left, self._waited = np.inf, 0.0
            self.outcome = CommonReason.HOMING_ARRIVED if last else None
        elif self._waited > _LONGEST_WAIT:
            self.outcome = CommonReason.HOMING_HELD_UP

    def _check_paths(self, start: Array) -> Iterator[list[Array] | None]:
        """Check one candidate path after the other.

        Yields:
            None for each posture that is checked, so that the work can be spread over ticks. At the end, the waypoints
            of the first free path, or an empty list if no path is free.
        """
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
        """Yield candidate paths, each as the tuple of its waypoints between ``start`` and the goal."""
        robot, goal = self._robot, self._goal
        yield ()
        if self._straight:
            return
        for arm in robot.arms.values():
            first = start.copy()
            first[arm.joints] = goal[arm.joints]
            yield (first,)
        random = np.random.default_rng(0)  # The fixed seed gives the same path for the same start.
        for number in range(_RANDOM_PATHS):
            middle = goal if number % 2 else start + random.uniform(0.2, 0.8) * (goal - start)
            point = middle + random.normal(0.0, _SPREAD, len(goal))
            yield (np.clip(point, robot.position_lower + _INSIDE, robot.position_upper - _INSIDE),)


def _samples(points: list[Array]) -> Iterator[Array]:
    """Yield postures (nv,) [rad] along a path. Each leg's end comes first: if it is not free, the leg is useless."""
    for a, b in pairwise(points):
        count = max(int(np.abs(b - a).max() / _SAMPLE), 1)
        for share in (1.0, *(i / count for i in range(1, count))):
            yield a + share * (b - a)


_LINEAR_SPEED, _ANGULAR_SPEED = 0.1, 0.3  # Greatest speeds of the tools' targets [m/s], [rad/s].
_ARRIVED, _TURNED = 0.003, 0.01  # A tool has arrived if its pose is this near to the home pose [m], [rad].
_PATIENCE = 5.0  # The tools may arrive later than their targets by up to this time [s].


class ToolHoming:
    """Moves all tools home at the same time, on straight lines. If the QP keeps a tool from its path, homing ends."""

    def __init__(self, home: Mapping[str, pin.SE3], tool_pose: Callable[[str], pin.SE3]) -> None:
        """Prepare the motion to the poses ``home``. ``tool_pose`` returns the tool pose of an arm in the reference."""
        self._home, self._tool_pose = dict(home), tool_pose
        self._start = {arm: tool_pose(arm) for arm in home}
        motions = [apart(start, home[arm]) for arm, start in self._start.items()]
        self._duration = max(max(distance / _LINEAR_SPEED, turn / _ANGULAR_SPEED, 0.1) for distance, turn in motions)
        self._time = 0.0

    def step(self, q: Array, v: Array, dt: float) -> HomingStep:
        """See :class:`WayHome`."""
        self._time += dt
        share = min(self._time / self._duration, 1.0)
        targets: dict[str, pin.SE3 | None] = {}
        for arm, start in self._start.items():
            shift = self._home[arm].translation - start.translation
            turn = pin.log3(start.rotation.T @ self._home[arm].rotation)
            targets[arm] = pin.SE3(start.rotation @ pin.exp3(share * turn), start.translation + share * shift)
        return HomingStep(None, targets)

    @property
    def outcome(self) -> ReasonKind | None:
        """See :class:`WayHome`."""
        if self._time < self._duration:
            return None
        errors = [apart(self._tool_pose(arm), home) for arm, home in self._home.items()]
        if all(distance <= _ARRIVED and turn <= _TURNED for distance, turn in errors):
            return CommonReason.HOMING_ARRIVED
        return CommonReason.HOMING_HELD_UP if self._time > self._duration + _PATIENCE else None


class Homing:
    """Begins, continues and ends the motion home.

    With ``tools_only``, this class gives targets to the tools and moves no joints, because another controller moves
    them.
    """

    def __init__(self, robot: Robot, controller: CartesianController, tools_only: bool) -> None:
        self._robot, self._controller, self._tools_only = robot, controller, tools_only
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._motion: WayHome | None = None
        self.outcome: Reason | None = None  # How the last motion home ended; None if :meth:`end` ended it.

    @property
    def active(self) -> bool:
        return self._motion is not None

    def begin(self, goal: Array | None = None) -> None:
        """Begin the motion home. If ``goal`` (nv,) [rad] is given, move all joints straight to that posture instead."""
        self.outcome = None
        if goal is None and self._tools_only:
            self._motion = ToolHoming(self._home, self._controller.tool_pose)
        else:
            to, straight = (self._robot.home, False) if goal is None else (goal, True)
            self._motion = JointHoming(self._robot, partial(self._controller.pairs_ahead, _STOP), to, straight)

    def targets(self, last: Reference | None, dt: float) -> dict[str, pin.SE3 | None]:
        """Return the target of each tool for the next ``dt`` [s]; None for an arm that goes home by joint setpoints.

        Args:
            last: The last reference.
            dt: Duration of the tick [s].
        """
        if self._motion is None or last is None:
            return dict.fromkeys(self._robot.arms)
        step = self._motion.step(last.q, last.v, dt)
        self._controller.hold_at(step.joints)
        return dict.fromkeys(self._robot.arms) | step.targets

    def check(self, reference: Reference) -> Reason | None:
        """End the motion home if the arms have arrived or cannot go on. Return the outcome; None if it continues.

        Args:
            reference: The newest reference. If the arms cannot move on, the outcome names the pair with the least
                margin.
        """
        kind = None if self._motion is None else self._motion.outcome
        if kind is None:
            return None
        self.end()
        by = {"by": " | ".join(reference.report.tightest_pair)} if kind is CommonReason.HOMING_HELD_UP else {}
        self.outcome = Reason(kind, by)
        return self.outcome

    def end(self) -> None:
        """Let the arms hold where they come to rest."""
        if self._motion is not None:
            self._controller.hold_at(None)
        self._motion = None

    def hold(self) -> Reason | None:
        """Interrupt the motion home, and record this in ``outcome``. Returns None, because this is never refused."""
        if self.active:
            self.end()
            self.outcome = Reason(CommonReason.HOMING_INTERRUPTED)
        return None
