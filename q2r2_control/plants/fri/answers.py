"""Compute the posture in an answer to a cabinet: the reference between two ticks, at the time of the answer.

**Two clocks.** A cabinet sends its questions by its own clock, which drifts against ours, through a network that delays
and loses messages. To the cabinet, the difference between the positions of two answers, divided by its period, is a
velocity. If an answer were for the time at which its question arrived, the jitter of the network would reach the arm.
The times of answers are therefore evenly spaced: each one is one period after the time of the newest answer that the
cabinet has heard.

**Catching up.** Lost messages and drift let the times of answers fall behind the questions. These times catch up at a
rate of 1 + ``CATCH_UP`` at most, and the rate changes by at most ``CATCH_UP_RAMP`` per second. If the reference has the
velocity v and the acceleration a, the cabinet sees at most the velocity (1 + CATCH_UP) v and the acceleration (1 +
CATCH_UP)^2 a + CATCH_UP_RAMP v.

**Never beyond the certificate.** If the newest reference ends before the time of an answer, because our loop is late,
the answer lies on the reference's certified stop. The loop then lets its own reference follow the same stop for the
same time.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from q2r2_control.control.cubic import cubic
from q2r2_control.types import Array

CATCH_UP = 0.05  # The rate at which the times of answers pass differs from 1 by at most this number.
CATCH_UP_RAMP = 0.4  # Greatest change of this rate per second [1/s].
# If a cabinet's clock is slower than assumed, ``MessageClock`` adapts to this clock within this number of messages.
_SETTLED = 500
_PIECES = 1024  # Number of pieces of the path that are kept. A piece is the motion of one tick, or a stop.
# Number of answers whose time is remembered. At the shortest period of 1 ms, these answers span four times the lag
# above which an arm is no longer commanded (_LONGEST_LAG in session_state.py).
_REMEMBERED = 1024


class _Move(NamedTuple):
    """The motion from the posture and velocity of one tick to those of the next tick."""

    start: float  # Time of the start [s].
    end: float  # Time of the end [s].
    q: tuple[Array, Array]  # Postures at the start and at the end [rad].
    v: tuple[Array, Array]  # Velocities at the start and at the end [rad/s].
    deceleration: Array  # Deceleration of the certified stop that begins at the end [rad/s^2].

    def at(self, t: float) -> tuple[Array, Array]:
        """Return posture and velocity at ``t`` [s], on the cubic through both ends.

        The cubic is a parabola if the acceleration is constant.
        """
        h = self.end - self.start
        return cubic(min(max((t - self.start) / h, 0.0), 1.0), h, self.q, self.v)

    @property
    def stop(self) -> _Stop:
        return _Stop(self.end, self.q[1], self.v[1], self.deceleration)


class _Stop(NamedTuple):
    """The certified stop from a posture and a velocity."""

    start: float  # Time at which the braking starts [s].
    q: Array  # Posture at the start (n,) [rad].
    v: Array  # Velocity at the start (n,) [rad/s].
    deceleration: Array  # Deceleration of each joint until it rests (n,) [rad/s^2].

    def at(self, t: float) -> tuple[Array, Array]:
        ran = np.minimum(max(t - self.start, 0.0), np.abs(self.v) / self.deceleration)
        lost = np.sign(self.v) * self.deceleration * ran
        return self.q + (self.v - 0.5 * lost) * ran, self.v - lost


_start = attrgetter("start")


class ReferencePath:
    """The reference of the last ticks, and the certified stop that follows the newest tick."""

    def __init__(self, t: float, q: Array) -> None:
        """Make the path of an arm that rests at ``q`` (n,) [rad] from ``t`` [s] on."""
        self._pieces: tuple[_Move | _Stop, ...] = ()
        self._stop = _Stop(t, q, np.zeros_like(q), np.ones_like(q))

    @property
    def end(self) -> float:
        """The end of the reference, after which the path contains only the stop [s]."""
        return self._stop.start

    @property
    def rest(self) -> Array:
        """The posture in which the stop ends (n,) [rad]."""
        return self._stop.at(math.inf)[0]

    def extend(self, t: float, q: Array, v: Array, deceleration: Array, start: float = -math.inf) -> None:
        """Add the motion of one tick, and the certified stop that follows it.

        Until ``start``, the path follows the earlier stop. The motion then leads to ``q`` and ``v``.

        Args:
            t: Time at which the motion ends [s].
            q: Posture at its end (n,) [rad].
            v: Velocity at its end (n,) [rad/s].
            deceleration: Deceleration of the stop from its end (n,) [rad/s^2].
            start: Time at which the motion leaves the earlier stop [s]; by default the start of that stop.
        """
        stop, start = self._stop, max(start, self._stop.start)
        there, speed = stop.at(start)
        followed = (stop,) if start > stop.start else ()
        self._pieces = (*self._pieces[-_PIECES:], *followed, _Move(start, t, (there, q), (speed, v), deceleration))
        self._stop = _Stop(t, q, v, deceleration)

    def brake(self, t: float) -> None:
        """Remove all motions after the piece that contains ``t`` [s], so that only the piece's certified stop follows.

        The stop begins at the end of the piece. If it began at ``t``, a joint that is nearly at rest at the end of the
        piece would hardly brake, because the joint's deceleration is small.
        """
        piece = self._piece(t)
        if piece is not self._stop:
            self._pieces = tuple(before for before in self._pieces if before.start <= piece.start)
            self._stop = piece if isinstance(piece, _Stop) else piece.stop

    def at(self, t: float) -> Array:
        """Return the posture at ``t`` [s] (n,) [rad]."""
        return self._piece(t).at(t)[0]

    def _piece(self, t: float) -> _Move | _Stop:
        if t >= self._stop.start or not self._pieces:
            return self._stop
        return self._pieces[max(bisect_right(self._pieces, t, key=_start) - 1, 0)]


class _Answer(NamedTuple):
    time: float  # The answer contains the posture of the path at this time [s].
    rate: float  # The time of this answer minus the time of the previous answer, divided by the period [s/s].


class MessageClock:
    """Estimates when a cabinet's messages would come without any delay, in seconds of our clock.

    A message may be late but never early. If a message comes before it was expected, the cabinet's clock is faster than
    it was assumed.
    """

    def __init__(self, arrival: float) -> None:
        """``arrival`` is the time at which the first message came [s]."""
        self._taken, self.expected = 1, arrival  # Number of messages so far, and the expected time of the newest one.

    def update(self, arrival: float, passed: float) -> None:
        """Update the estimate with a newer message, which came at ``arrival`` [s].

        ``passed`` is the time from the previous message to this message, by the cabinet's clock [s].
        """
        self._taken += 1
        expected = self.expected + passed
        late = arrival - expected
        self.expected = arrival if late < 0.0 else expected + late / min(self._taken, _SETTLED)


class AnswerTimes:
    """Computes the evenly spaced times for which one cabinet gets answers, in seconds of our clock."""

    def __init__(self, period: float, delay: float) -> None:
        """Make the times of one cabinet.

        Args:
            period: Time between two answers [s].
            delay: The time of an answer is this much earlier than the expected time of its question [s].
        """
        self._period, self._delay = period, delay
        self._question = -1  # The counter of the newest question.
        self._answers: dict[int, _Answer] = {}  # The last answers by their counter.
        self._newest: _Answer | None = None  # The answer for the latest time.
        # The counter of the first answer since the restart, and a virtual answer one period before it; None if there
        # was no answer since. Until the cabinet has heard the first answer, times continue from the virtual answer.
        self._begin: tuple[int, _Answer] | None = None

    def restart(self) -> None:
        """Forget all answers, so that the next answer may be for any time. The arm has to stand still."""
        self._answers, self._newest, self._begin = {}, None, None

    def _heard(self, counter: int) -> _Answer:
        """Return the answer with ``counter``, or the oldest answer that is remembered."""
        return self._answers.get(counter) or self._answers[min(self._answers)]

    def at(self, question: int, expected: float, counter: int, heard: int) -> float:
        """Return the time on the path for an answer [s]. A repeated question gets the newest time again.

        Args:
            question: The counter of the question.
            expected: The expected time of the question [s].
            counter: The counter of our answer.
            heard: The counter of our newest answer that the cabinet has heard.
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
        # Times go on from the answer that the cabinet has heard, because the cabinet has not followed any later answer.
        before = standing if heard < first or newest is None else self._heard(heard)
        lag = (wanted - before.time) / self._period - 1.0  # The lag as a number of answers.
        ramp = CATCH_UP_RAMP * self._period
        # The rate minus 1 can fall by at most CATCH_UP_RAMP per second. ``excess`` is its greatest value from which it
        # can still fall to 0 by the time at which the lag becomes 0.
        excess = math.copysign(math.sqrt(2.0 * ramp * abs(lag) + 0.25 * ramp * ramp) - 0.5 * ramp, lag)
        excess = min(max(excess, -CATCH_UP), CATCH_UP)
        rate = min(max(1.0 + excess, before.rate - ramp), before.rate + ramp)
        answer = _Answer(before.time + rate * self._period, rate)
        self._answers[counter] = answer
        self._newest = answer if newest is None else max(newest, answer)
        return answer.time
