"""The way of all arms to a posture, such as home, in joint space: straight, or by way points around what is between.

Straight in the space of the joints every posture ends at the goal, elbows and turns of the wrist too, which a
line of the tools does not. What is sent is not the way itself but joint positions for the controller to hold, which
keeps every promise on the way there. The way is stretched in time where the arms lag behind, so an arm that is held up
is waited for, and when it is free again it sets off little faster than it was.

Which way is free is looked for by samples of the distances, a few at a tick, while the arms stand still: straight; one
arm first; by a random posture. Nobody's safety rests on what is found, because the controller is what keeps the arms
apart; it need only lead somewhere.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from itertools import pairwise

import numpy as np

from q2r2_control.events import ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_SPEED = 0.3  # of the fastest joint [rad/s]
_SLOWED, _WAITED = 0.09, 0.12  # by how much the arms lag behind where the way is slowed, and where it waits [rad]
_PASSED, _ARRIVED = 0.1, 0.003  # how near the arms come to a way point, and to the goal [rad]
_PATIENCE, _PROGRESS = 3.0, 1e-3  # without progress of so much [s], [rad]
_AT_REST = 0.02  # [rad/s]
_ROOM = 0.003  # more than what a pair keeps [m]
_SAMPLE = 0.05  # between two samples of a way [rad]
_SAMPLES_A_TICK = 2
_RANDOM_WAYS = 300
_SPREAD = 0.6  # of random way points [rad]
_INSIDE = 0.02  # of joint limits [rad]


class JointHoming:
    """Leads all joints to a goal, from where they come to rest."""

    def __init__(self, robot: Robot, kept: Array, goal: Array) -> None:
        """``kept`` (pairs,) [m]: what each monitored pair keeps; ``goal`` (nv,) [rad]."""
        self._robot, self._kept = robot, kept
        self._goal = goal
        self._needed = kept
        self._search: Iterator[tuple[Array, ...]] | None = None
        self._points: list[Array] | None = None  # still to be reached, the goal last
        self._at = self._leg = self._goal  # where the joints shall be, and where the leg to the next point began
        self._share = 0.0  # of the leg
        self._least_left = np.inf  # of the way to the next point, of the joint that has the most [rad]
        self._waited = 0.0  # without progress [s]
        self.outcome: ReasonKind | None = None  # how it ended

    def step(self, q: Array, v: Array, dt: float) -> Array | None:
        """Where the joints shall be (nv,) after another ``dt`` [s], with the reference at ``q`` and ``v`` (nv,).

        None: where they come to rest.
        """
        if self._search is None:
            if float(np.abs(v).max()) > _AT_REST:
                return None
            # A pair that has less room where the way begins needs no more than that.
            self._needed = np.minimum(self._kept + _ROOM, self._robot.distance_values(q) - 1e-4)
            self._at = self._leg = q.copy()
            self._search = self._ways(self._at)
        if self._points is None:
            self._look(self._search)
        elif self._points:
            self._go(q, dt)
        return self._at

    def _look(self, search: Iterator[tuple[Array, ...]]) -> None:
        for _ in range(_SAMPLES_A_TICK):
            found = next(search, None)
            if found is None:
                self.outcome = ReasonKind.HOMING_NO_WAY
                return
            if found:
                self._points = list(found)
                return

    def _go(self, q: Array, dt: float) -> None:
        assert self._points
        goal, last = self._points[0], len(self._points) == 1
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
        if self._share == 1.0 and left < (_ARRIVED if last else _PASSED):
            self._points.pop(0)
            self._leg, self._share = goal, 0.0
            self._least_left, self._waited = np.inf, 0.0
            self.outcome = ReasonKind.HOMING_ARRIVED if last else None
        elif self._waited > _PATIENCE:
            self.outcome = ReasonKind.HOMING_HELD_UP

    def _ways(self, start: Array) -> Iterator[tuple[Array, ...]]:
        """Samples one way after the other: an empty tuple after each sample, and the way points of one that is free."""
        goal = self._goal
        for between in self._candidates(start):
            points = [start, *between, goal]
            for a, b in pairwise(points):
                free = yield from self._sample(a, b)
                if not free:
                    break
            else:
                yield (*between, goal)
                return

    def _candidates(self, start: Array) -> Iterator[tuple[Array, ...]]:
        """Way points between ``start`` and the goal."""
        robot, goal = self._robot, self._goal
        yield ()
        for arm in robot.arms.values():
            first = start.copy()
            first[arm.joints] = goal[arm.joints]
            yield (first,)
        random = np.random.default_rng(0)  # the same way at every time
        for number in range(_RANDOM_WAYS):
            middle = goal if number % 2 else start + random.uniform(0.2, 0.8) * (goal - start)
            point = middle + random.normal(0.0, _SPREAD, len(goal))
            yield (np.clip(point, robot.position_lower + _INSIDE, robot.position_upper - _INSIDE),)

    def _sample(self, a: Array, b: Array) -> Generator[tuple[Array, ...], None, bool]:
        """Whether every pair has room all the way; the end first, since a bad way point is not worth the way there."""
        count = max(int(np.abs(b - a).max() / _SAMPLE), 1)
        for share in (1.0, *(i / count for i in range(1, count))):
            yield ()
            if (self._robot.distance_values(a + share * (b - a)) < self._needed).any():
                return False
        return True
