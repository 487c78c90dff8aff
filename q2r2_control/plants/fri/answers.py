"""Where the arms have to be when a cabinet asks: the reference between ticks, and the time that an answer is for.

**Two clocks.** A cabinet asks by its own clock, which drifts against ours, through a network that jitters and loses.
It takes the difference of two answers over its period for a velocity. An answer for the very time at which a question
arrived would pass the network's jitter on to the arm. An answer is therefore for an even time: that of the newest
answer that the cabinet has heard, and one period more.

**Catching up.** Lost messages and drift let the even time fall behind. It catches up at up to ``CATCH_UP`` of its
rate, and its rate changes by ``CATCH_UP_RAMP`` a second. With the reference at v and a the cabinet sees at most
(1 + CATCH_UP) v and (1 + CATCH_UP)^2 a + CATCH_UP_RAMP v.

**Never beyond what is certified.** Where the newest reference ends before the answer's time, since our loop is late,
its certified stop follows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from q2r2_control.types import Array

CATCH_UP = 0.02  # of an even time's rate
CATCH_UP_RAMP = 0.4  # of that rate [1/s]
_SETTLED = 500  # messages over which the arrivals are averaged
_PIECES = 128  # of the reference that are kept
_REMEMBERED = 64  # answers of which the time is known


class _Piece(NamedTuple):
    """The reference between two ticks, by the posture and velocity at both."""

    start: float  # [s]
    end: float
    q: tuple[Array, Array]  # [rad]
    v: tuple[Array, Array]  # [rad/s]


class ReferencePath:
    """The reference of the last ticks and the certified stop from the newest. One thread extends it, others read."""

    def __init__(self, t: float, q: Array) -> None:
        """At rest at ``q`` (nv,) [rad] until ``t`` [s]."""
        self._pieces: tuple[_Piece, ...] = (_Piece(-math.inf, t, (q, q), (0.0 * q, 0.0 * q)),)
        self._stop = np.ones_like(q)

    @property
    def end(self) -> float:
        """Time up to which there is a reference [s]."""
        return self._pieces[-1].end

    def extend(self, t: float, q: Array, v: Array, deceleration: Array) -> None:
        """The reference is at ``q``, ``v`` at the time ``t`` [s]; its certified stop brakes at ``deceleration``."""
        last = self._pieces[-1]
        self._stop = deceleration
        self._pieces = (*self._pieces[1 - _PIECES :], _Piece(last.end, t, (last.q[1], q), (last.v[1], v)))

    def at(self, t: float) -> Array:
        """Posture (nv,) [rad] at ``t`` [s]."""
        pieces, stop = self._pieces, self._stop
        last = pieces[-1]
        if t >= last.end:
            v = last.v[1]
            ran = np.minimum(t - last.end, np.abs(v) / stop)
            return np.asarray(last.q[1] + v * ran - 0.5 * np.sign(v) * stop * ran**2)
        piece = next((piece for piece in reversed(pieces) if piece.start <= t), pieces[0])
        if not math.isfinite(piece.start):
            return piece.q[0]
        # The cubic through both ends: with the controller's constant acceleration it is that parabola.
        h = piece.end - piece.start
        x = (t - piece.start) / h
        way = piece.q[1] - piece.q[0]
        return np.asarray(
            piece.q[0] + x * x * (3.0 - 2.0 * x) * way + x * (1.0 - x) * h * ((1.0 - x) * piece.v[0] - x * piece.v[1])
        )


class AnswerTimes:
    """The even times of one cabinet's answers, all in [s] of our clock."""

    def __init__(self, period: float, delay: float) -> None:
        """``period`` between two answers; ``delay``: an answer is for that long before its question arrived."""
        self._period, self._delay = period, delay
        self._questions = 0
        self._arrival, self._counter = 0.0, 0  # of the newest question, averaged
        self._rate = 1.0
        self._times: dict[int, float] = {}  # of our answers by their counter

    def restart(self) -> None:
        """The arm stands still at a new path's begin, so that the next answer may be for any time."""
        self._times, self._rate = {}, 1.0

    def at(self, question: int, arrival: float, counter: int, heard: int) -> float:
        """The time that our answer ``counter`` to a ``question`` is for, that came at ``arrival``.

        ``heard``: counter of our newest answer that the cabinet knows of.
        """
        if self._times and question == self._counter:  # it came twice
            self._times[counter] = time = max(self._times.values())
            return time
        wanted = self._even(question, arrival) - self._delay
        before = self._times.get(heard, max(self._times.values(), default=wanted - self._period))
        lag = (wanted - before) / self._period - 1.0  # in answers
        ramp = CATCH_UP_RAMP * self._period
        # The greatest excess of rate from which the ramp still comes back to 0 as the lag does.
        excess = math.copysign(math.sqrt(2.0 * ramp * abs(lag) + 0.25 * ramp * ramp) - 0.5 * ramp, lag)
        excess = min(max(excess, -CATCH_UP), CATCH_UP)
        self._rate = min(max(1.0 + excess, self._rate - ramp), self._rate + ramp)
        time = before + self._rate * self._period
        self._times = {known: t for known, t in self._times.items() if known > counter - _REMEMBERED}
        self._times[counter] = time
        return time

    def _even(self, question: int, arrival: float) -> float:
        self._questions += 1
        if self._questions == 1:
            self._arrival = arrival
        else:
            expected = self._arrival + (question - self._counter) * self._period
            self._arrival = expected + (arrival - expected) / min(self._questions, _SETTLED)
        self._counter = question
        return self._arrival
