"""A late tick is no jump: by how much time the reference may move in one tick.

A plant takes one command a period: a joint may do what its velocity limit allows in one period, however late the
command comes. A tick that is late moves the reference by the time t that passed, but no joint by more than its limit V
allows in a period h:  |v| t + a t^2 / 2 <= V h  for each joint, with the acceleration limit a, or by one period, which
no joint's limit forbids. Slow motion catches up at once, and fast motion is stretched in time: the same path, later. A
command that is clipped joint by joint would leave the path that was certified.

A plant that is told a velocity goes on at it while no command comes (``coasts``). Then the reference goes on too, by
the time that passed, up to 0.1 s; what is commanded stays within the velocity limit.
"""

from __future__ import annotations

import math

import numpy as np

from q2r2_control.types import LONGEST_DT, Array

_ROUNDING = 1e-9  # of a period


class TickPacer:
    """Turns the time since the last tick into the time that the reference moves by, and counts what was late."""

    def __init__(self, period: float, velocity_limit: Array, acceleration_limit: Array, coasts: bool = False) -> None:
        """``period`` [s] of the commands; ``velocity_limit`` [rad/s], ``acceleration_limit`` [rad/s^2], (n,) each."""
        self.period = period
        self.missed_ticks = 0  # commands that were due and did not come
        self.stretched = 0.0  # time by which the motion is late for it [s]
        self._way = velocity_limit * period  # in one period [rad]
        self._acceleration = acceleration_limit
        self._coasts = coasts

    def step(self, gap: float, v: Array) -> float:
        """Time [s] for the reference to move by, ``gap`` [s] after the last tick, from velocities ``v`` (nv,) [rad/s].

        Not more than ``gap``; 0 for a clock that did not advance.
        """
        if not gap > self.period * (1.0 + _ROUNDING):
            return gap if gap > 0.0 else 0.0
        # Half a period late is jitter; from there on a command is missing.
        self.missed_ticks += max(round(gap / self.period) - 1, 0)
        # The time in which each joint can have used up its way.
        longest = 2.0 * self._way / (np.abs(v) + np.sqrt(v * v + 2.0 * self._acceleration * self._way))
        step = min(gap, LONGEST_DT if self._coasts else max(self.period, float(longest.min())))
        self.stretched += gap - step
        return step


_SHARE = 0.02  # of what the even time is off is made up in a tick


class TickClock:
    """Turns the times at which ticks ran into the times for which they count, all in [s]."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._last = -math.inf

    def at(self, now: float) -> float:
        """The time for which a tick that runs at ``now`` counts: within half a period of it, or again the last one.

        Time begins anew after more than 0.1 s, and where it was set back.
        """
        off = now - self._last - self._period
        if not -2.0 * self._period < off < LONGEST_DT:
            self._last = now
            return now
        missed = round(off / self._period)
        if missed >= 0:
            self._last += (1 + missed) * self._period + _SHARE * (off - missed * self._period)
        return self._last
