"""Find a controller that stands still: its commands change, but the measured arm does not move.

A controller whose process is frozen is still in the ROS graph, and its middleware still acknowledges messages. The
joint states still come, from another process. Meanwhile the reference moves away from the arm. When the controller
wakes up, its newest command is a jump. An arm that only lags moves at the speed that was commanded a little earlier. An
arm whose controller stands still does not move at all, which shows within a few states:

    path of m in W <= 0.1 |r(t) - r(t - W)|,  |r(t) - r(t - W)| >= least,  |r(t - W) - m(t)| >= ahead.

Here r is the commanded and m the measured position: the joints of an arm, of which the greatest value counts, or its
tool. W is the window. An arm that lags by L and reverses still moves by the share W / (4 L) of the commanded distance,
which is more than 0.1 for a lag up to 0.12 s. Nothing is judged while no new states come, or just after this loop was
late.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from q2r2_control.events import Reason
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.types import Array, RobotState

WINDOW = 0.05  # Length W of the window [s].
_STANDS_BELOW = 0.1  # An arm stands still if it moves by less than this share of the commanded distance.
_FOLLOWS_ABOVE = 0.5  # An arm follows if it moves by more than this share of the commanded distance.
_LOOK_PERIOD = 0.0075  # Least time between two checks; the loop may tick more often [s].
_STATE_GAP = 0.045  # If the gap between two states is longer than this, the window begins again [s].


@dataclass(frozen=True, slots=True)
class StandstillLimits:
    """Distances [rad] of joints or [m] of a tool, and times, above which an arm counts as standing still."""

    least: float  # The command must move at least this far within the window.
    ahead: float  # The command at the beginning of the window must be at least this far from the measured arm.
    # Time for which the arm must stand still [s]. An arm whose controller lags also stands still while it reverses.
    patience: float = 0.0
    begins: float = 0.0  # The same time for an arm that has not followed yet, and may need time to begin [s].


# Limits for a driver that takes joint commands [rad]. Its filter and its session may need a moment to begin.
JOINTS = StandstillLimits(least=0.01, ahead=0.01, begins=0.05)
# Limits for a controller that takes poses. Its inverse kinematics may lag by 0.4 s [rad], [m].
LAGGING_JOINTS = StandstillLimits(least=0.01, ahead=0.01, patience=0.08, begins=0.4)
LAGGING_TOOL = StandstillLimits(least=0.01, ahead=0.02, patience=0.08, begins=0.4)


class StandstillWatch:
    """Judges one arm. Arrays are (n,). The caller gives all times [s]."""

    def __init__(self, limits: StandstillLimits) -> None:
        self._limits = limits
        self.reset()

    def reset(self) -> None:
        """Forget everything. The arm is judged again after a whole window of states."""
        # For each measured state: its time, the command, and the measured path since the first state.
        self._seen: deque[tuple[float, Array, Array]] = deque()
        self._measured: Array | None = None
        self._stamp = -math.inf
        self._since, self._follows = math.inf, False

    def look(self, asked: Array, measured: Array, stamp: float, now: float) -> float | None:
        """Return how far the command moved while the arm stood still; None if the arm does not stand still.

        The result has the unit of the arrays: [rad] for joints and [m] for a tool.

        Args:
            asked: The newest command that was sent before this tick (n,).
            measured: The measured position (n,).
            stamp: The time at which ``measured`` was received [s].
            now: The time of this tick [s].
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
        way, moved = _largest_change(asked, asked_then), _largest_change(self._seen[-1][2], path_then)
        if max(way, moved) < self._limits.least:
            self._follows = False  # Neither command nor arm has moved: the arm is at rest, and may need time to begin.
        elif moved > _FOLLOWS_ABOVE * way:
            self._follows = True
        ahead = _largest_change(asked_then, measured)
        stands = way >= self._limits.least and moved <= _STANDS_BELOW * way and ahead >= self._limits.ahead
        self._since = min(self._since, now) if stands else math.inf
        needed = self._limits.patience if self._follows else max(self._limits.begins, self._limits.patience)
        return way if stands and now - self._since >= needed else None


class StandingArms:
    """Finds arms that stand still, from their commanded and measured joint positions."""

    def __init__(self, robot: Robot, limits: StandstillLimits, takers: Callable[[str], str]) -> None:
        self._joints = {arm: its.joints for arm, its in robot.arms.items()}
        self._watches = {arm: StandstillWatch(limits) for arm in robot.arms}
        self._takers, self._looked = takers, -math.inf

    def look(self, asked: Array, state: RobotState, now: float) -> Reason | None:
        """Return a reason if an arm does not move to the commanded posture ``asked`` (nv,) [rad], else None."""
        if 0.0 <= now - self._looked < _LOOK_PERIOD:
            return None
        self._looked = now
        for arm, joints in self._joints.items():
            way = self._watches[arm].look(asked[joints], state.q[joints], state.stamp, now)
            if way is not None:
                return standing(arm, self._takers(arm), way, "rad")
        return None


def standing(arm: str, takers: str, way: float, unit: str) -> Reason:
    """Return the reason for an arm that stood still while its command moved by ``way`` (in ``unit``) in the window."""
    kind = SupervisionReason.CONTROLLER_STANDS
    return Reason.of(kind, None, arm=arm, takers=takers, way=way, unit=unit, time=WINDOW)


def _largest_change(end: Array, start: Array) -> float:
    return float(np.abs(end - start).max())
