"""Where the arms have to be when a cabinet asks: the reference between ticks, and the time that an answer is for.

**Two clocks.** A cabinet asks by its own clock, which drifts against ours, through a network that jitters and loses.
It takes the difference of two answers over its period for a velocity. An answer for the very time at which a question
arrived would pass the network's jitter on to the arm. An answer is therefore for an even time: that of the newest
answer that the cabinet has heard, and one period more.

**Catching up.** Lost messages and drift let the even time fall behind. It catches up at up to ``CATCH_UP`` of its
rate, and its rate changes by ``CATCH_UP_RAMP`` a second. With the reference at v and a the cabinet sees at most
(1 + CATCH_UP) v and (1 + CATCH_UP)^2 a + CATCH_UP_RAMP v.

**Never beyond what is certified.** Where the newest reference ends before the answer's time, since our loop is late,
its certified stop follows. The loop then lets its own reference follow the same stop for as long.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from q2r2_control.types import Array

CATCH_UP = 0.05  # of an even time's rate
CATCH_UP_RAMP = 0.4  # of that rate [1/s]
_SETTLED = 500  # messages in which a clock that is slower than it was taken for is followed
_PIECES = 1024  # of the reference that are kept
# Answers of which the time is known. At the shortest period of 1 ms they last four times as long as a cabinet that
# hears none of them is followed.
_REMEMBERED = 1024


class _Move(NamedTuple):
    """From one tick's posture and velocity to the next one's."""

    start: float  # [s]
    end: float
    q: tuple[Array, Array]  # [rad]
    v: tuple[Array, Array]  # [rad/s]
    deceleration: Array  # of the certified stop from its end [rad/s^2]

    def at(self, t: float) -> tuple[Array, Array]:
        """Posture and velocity by the cubic through both ends: with a constant acceleration it is that parabola."""
        (q, end), (v, end_v), h = self.q, self.v, self.end - self.start
        x = min(max((t - self.start) / h, 0.0), 1.0)
        way = end - q
        there = q + x * x * (3.0 - 2.0 * x) * way + x * (1.0 - x) * h * ((1.0 - x) * v - x * end_v)
        speed = 6.0 * x * (1.0 - x) / h * way + (1.0 - x) * (1.0 - 3.0 * x) * v + x * (3.0 * x - 2.0) * end_v
        return there, speed

    @property
    def stop(self) -> _Stop:
        return _Stop(self.end, self.q[1], self.v[1], self.deceleration)


class _Stop(NamedTuple):
    """The certified stop from a posture and a velocity."""

    start: float  # [s]
    q: Array  # [rad]
    v: Array  # [rad/s]
    deceleration: Array  # [rad/s^2]

    def at(self, t: float) -> tuple[Array, Array]:
        ran = np.minimum(max(t - self.start, 0.0), np.abs(self.v) / self.deceleration)
        lost = np.sign(self.v) * self.deceleration * ran
        return self.q + (self.v - 0.5 * lost) * ran, self.v - lost


_start = attrgetter("start")


class ReferencePath:
    """The reference of the last ticks, and the certified stop from the newest."""

    def __init__(self, t: float, q: Array) -> None:
        """At rest at ``q`` (n,) [rad] from ``t`` [s] on."""
        self._pieces: tuple[_Move | _Stop, ...] = ()
        self._stop = _Stop(t, q, np.zeros_like(q), np.ones_like(q))

    @property
    def end(self) -> float:
        """Time from which on there is nothing but the stop [s]."""
        return self._stop.start

    @property
    def rest(self) -> Array:
        """Posture (n,) [rad] in which the stop ends."""
        return self._stop.at(math.inf)[0]

    def extend(self, t: float, q: Array, v: Array, deceleration: Array, start: float = -math.inf) -> None:
        """The reference is at ``q``, ``v`` at the time ``t`` [s]; its certified stop brakes at ``deceleration``.

        It left the stop of before at ``start`` [s], or at once.
        """
        stop, start = self._stop, max(start, self._stop.start)
        there, speed = stop.at(start)
        followed = (stop,) if start > stop.start else ()
        self._pieces = (*self._pieces[-_PIECES:], *followed, _Move(start, t, (there, q), (speed, v), deceleration))
        self._stop = _Stop(t, q, v, deceleration)

    def brake(self, t: float) -> None:
        """Let nothing but its certified stop follow the move at ``t`` [s].

        The stop is that from the move's end. From its middle, a joint that nearly stands at the end would hardly brake.
        """
        piece = self._piece(t)
        if piece is not self._stop:
            self._pieces = tuple(before for before in self._pieces if before.start <= piece.start)
            self._stop = piece if isinstance(piece, _Stop) else piece.stop

    def at(self, t: float) -> Array:
        """Posture (n,) [rad] at ``t`` [s]."""
        return self._piece(t).at(t)[0]

    def _piece(self, t: float) -> _Move | _Stop:
        if t >= self._stop.start or not self._pieces:
            return self._stop
        return self._pieces[max(bisect_right(self._pieces, t, key=_start) - 1, 0)]


class _Answer(NamedTuple):
    time: float  # that it is for [s]
    rate: float  # of that time since the answer before


class MessageClock:
    """When a cabinet's messages would come if nothing made them late, in [s] of our clock.

    A message may be late, and none is early: one that comes before it was expected shows the cabinet's clock.
    """

    def __init__(self, arrival: float) -> None:
        """``arrival`` of the first message."""
        self._taken, self.expected = 1, arrival  # messages so far, and the time of the newest

    def update(self, arrival: float, passed: float) -> None:
        """A newer message, ``passed`` [s] after the one before by the cabinet's clock."""
        self._taken += 1
        expected = self.expected + passed
        late = arrival - expected
        self.expected = arrival if late < 0.0 else expected + late / min(self._taken, _SETTLED)


class AnswerTimes:
    """The even times of one cabinet's answers, all in [s] of our clock."""

    def __init__(self, period: float, delay: float) -> None:
        """``period`` between two answers; ``delay``: an answer is for that long before its question is expected."""
        self._period, self._delay = period, delay
        self._question = -1  # the newest one
        self._answers: dict[int, _Answer] = {}  # the last ones by their counter
        self._newest: _Answer | None = None  # that is for the latest time
        self._begin: tuple[int, _Answer] | None = None  # the first counter, and what the cabinet goes on from till then

    def restart(self) -> None:
        """The arm stands still, so that the next answer may be for any time."""
        self._answers, self._newest, self._begin = {}, None, None

    def _heard(self, counter: int) -> _Answer:
        """The answer that the cabinet goes on from, or the oldest that is known, which is the nearest to that one."""
        return self._answers.get(counter) or self._answers[min(self._answers)]

    def at(self, question: int, expected: float, counter: int, heard: int) -> float:
        """The time that our answer ``counter`` to a ``question`` is for, that is ``expected`` at a time.

        ``heard``: counter of our newest answer that the cabinet knows of.
        """
        newest, repeated, self._question = self._newest, question == self._question, question
        self._answers.pop(counter - _REMEMBERED, None)
        if newest is not None and repeated:
            self._answers[counter] = newest
            return newest.time
        wanted = expected - self._delay
        if self._begin is None:
            self._begin = counter, _Answer(wanted - self._period, 1.0)
        first, standing = self._begin
        # From the answer that the cabinet goes on from: what it did not hear was never done.
        before = standing if heard < first or newest is None else self._heard(heard)
        lag = (wanted - before.time) / self._period - 1.0  # in answers
        ramp = CATCH_UP_RAMP * self._period
        # The greatest excess of rate from which the ramp still comes back to 0 as the lag does.
        excess = math.copysign(math.sqrt(2.0 * ramp * abs(lag) + 0.25 * ramp * ramp) - 0.5 * ramp, lag)
        excess = min(max(excess, -CATCH_UP), CATCH_UP)
        rate = min(max(1.0 + excess, before.rate - ramp), before.rate + ramp)
        answer = _Answer(before.time + rate * self._period, rate)
        self._answers[counter] = answer
        self._newest = answer if newest is None else max(newest, answer)
        return answer.time
