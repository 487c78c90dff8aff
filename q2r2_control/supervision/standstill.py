"""A controller that stands still while what measures the arm goes on: asked for motion, the arm makes none.

A controller whose process is frozen, or whose loop hangs, still is in the graph, and its middleware still acknowledges.
Measured states of another process go on. Meanwhile the reference leaves the arm, and what was asked for last is a jump
at the moment in which the controller goes on. An arm that lags moves as fast as it was asked to a little earlier. One
that stands still does not, which shows within a few states:

    path of m in W <= 0.1 |r(t) - r(t - W)|,  |r(t) - r(t - W)| >= least,  |r(t - W) - m(t)| >= ahead,

with what was asked r and what is measured m, the greatest value of an arm's joints, or the way of its tool. An arm that
lags by L turns round on a path of W / (4 L) of what it is asked for meanwhile, so one that lags by 0.12 s is not found.
Where states have a gap nothing is judged. After a gap of this loop an arm has not yet been asked for what counts.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState

WINDOW = 0.05  # W [s]
_SHARE = 0.1  # of the way that was asked for, below which an arm stands
_FOLLOWS = 0.5  # of that way, above which it follows
_LOOK_PERIOD = 0.0075  # a loop may tick a thousand times a second [s]
_STATE_GAP = 0.045  # between two states; with more the window begins anew [s]


@dataclass(frozen=True, slots=True)
class StandstillLimits:
    """The motion that has to be asked for and missing, in [rad] of joints or [m] of a tool."""

    least: float  # asked for within the window
    ahead: float  # between what was asked for at its beginning and what is measured
    # For so long has the finding to hold: a controller that lags stands still where its arm turns round [s].
    patience: float = 0.0
    begins: float = 0.0  # the same where the arm has not followed yet: until it begins to [s]


# Limits for a driver that takes joint commands. Its filter and its session may have just begun [rad].
JOINTS = StandstillLimits(least=0.01, ahead=0.01, begins=0.05)
# Limits for a controller that takes poses. Its inverse kinematics may lag by 0.4 s [rad], [m].
LAGGING_JOINTS = StandstillLimits(least=0.01, ahead=0.01, patience=0.08, begins=0.4)
LAGGING_TOOL = StandstillLimits(least=0.01, ahead=0.02, patience=0.08, begins=0.4)


class StandstillWatch:
    """Judges one arm. Arrays are (n,); times are the caller's [s]."""

    def __init__(self, limits: StandstillLimits) -> None:
        self._limits = limits
        self.reset()

    def reset(self) -> None:
        """Forget all; the arm may stand still from now on."""
        # For each measured state: when, what was asked, the way that was measured since the first.
        self._seen: deque[tuple[float, Array, Array]] = deque()
        self._measured: Array | None = None
        self._stamp = -math.inf
        self._since, self._follows = math.inf, False

    def look(self, asked: Array, measured: Array, stamp: float, now: float) -> float | None:
        """At a tick at ``now``: how far the arm was asked to go while it stood still, or None.

        ``asked``: sent before this tick; ``measured`` has the ``stamp`` at which it was received.
        """
        if now - stamp > _STATE_GAP or stamp < self._stamp:
            self.reset()
        if stamp != self._stamp:
            self._stamp = stamp
            path = (
                np.zeros_like(measured)
                if self._measured is None
                else self._seen[-1][2] + np.abs(measured - self._measured)
            )
            self._measured = measured
            self._seen.append((now, asked, path))
        while len(self._seen) > 1 and now - self._seen[1][0] >= WINDOW:
            self._seen.popleft()
        if not self._seen or now - self._seen[0][0] < WINDOW:
            return None
        _, asked_then, path_then = self._seen[0]
        way, moved = _way(asked, asked_then), _way(self._seen[-1][2], path_then)
        if max(way, moved) < self._limits.least:
            self._follows = False  # at rest
        elif moved > _FOLLOWS * way:
            self._follows = True
        ahead = _way(asked_then, measured)
        stands = way >= self._limits.least and moved <= _SHARE * way and ahead >= self._limits.ahead
        self._since = min(self._since, now) if stands else math.inf
        needed = self._limits.patience if self._follows else max(self._limits.begins, self._limits.patience)
        return way if stands and now - self._since >= needed else None


class StandingArms:
    """Judges all arms by their joints."""

    def __init__(self, robot: Robot, limits: StandstillLimits, takers: Callable[[str], str]) -> None:
        self._joints = {arm: its.joints for arm, its in robot.arms.items()}
        self._watches = {arm: StandstillWatch(limits) for arm in robot.arms}
        self._takers, self._looked = takers, -math.inf

    def look(self, asked: Array, state: RobotState, now: float) -> Reason | None:
        """A reason where an arm does not go where it was ``asked`` to be (nv,) [rad], else None."""
        if 0.0 <= now - self._looked < _LOOK_PERIOD:
            return None
        self._looked = now
        for arm, joints in self._joints.items():
            way = self._watches[arm].look(asked[joints], state.q[joints], state.stamp, now)
            if way is not None:
                return standing(arm, self._takers(arm), way, "rad")
        return None


def standing(arm: str, takers: str, way: float, unit: str) -> Reason:
    """The reason for an arm that was asked to go a ``way`` within the window."""
    kind = ReasonKind.CONTROLLER_STANDS
    return Reason.of(kind, None, arm=arm, takers=takers, way=way, unit=unit, time=WINDOW)


def _way(end: Array, start: Array) -> float:
    return float(np.abs(end - start).max())
