"""Whether a message took much longer than its kind does: then it tells of the past, and must not move an arm.

A sender that is frozen in the middle of sending finishes when it goes on: one target or command of long ago leaves, and
whoever receives it takes it for the begin of something new. The delay is the time of receipt less that of sending,
read from clocks that may be of two hosts. So only differences between delays count: the least one of the past is the
usual one.
"""

from __future__ import annotations

import math
from collections import deque

# The usual delay may grow this fast: clocks of two hosts drift apart by less, and a frozen sender's delay by far more.
_DRIFT = 1e-3
# Messages that are late for as long as this show a clock that was set [s].
_CLOCK_WAS_SET = 1.0


class DelayWatch:
    """The delays of one topic's messages. Times are receipt times [s]."""

    def __init__(self, allowed: float) -> None:
        """``allowed``: how much longer than usual a message may take [s]."""
        self._allowed = allowed
        self._usual, self._stamp = math.inf, 0.0
        self._late_since: float | None = None

    @property
    def usual(self) -> float:
        """The least delay of the past [s], which clocks that drift apart may change; inf before the first message."""
        return self._usual

    def take(self, delay: float, now: float) -> float:
        """How much too late [s] a message is that came at ``now`` [s] with ``delay`` [s]; 0 if it may be used.

        A delay that is not finite is not known, and such a message may be used.
        """
        if not math.isfinite(delay):
            return 0.0
        usual = self._usual + _DRIFT * max(now - self._stamp, 0.0)
        if self._late_since is not None and now - self._late_since > _CLOCK_WAS_SET:
            usual = math.inf
        if delay - usual <= self._allowed:
            self._usual, self._stamp = min(delay, usual), now
            self._late_since = None
            return 0.0
        self._late_since = now if self._late_since is None else self._late_since
        return delay - usual


# No publisher sends faster, and none is delivered later than that: a larger step is another one's [Hz], [s].
_FASTEST, _LATEST = 2000.0, 0.1
# Numbers have to go on without a break for this long before a stream counts as one publisher's again [s].
_ALONE = 1.0


class SequenceWatch:
    """The numbers of one topic's messages. Times are receipt times [s]."""

    def __init__(self) -> None:
        self._number, self._stamp = 0, -math.inf
        self._breaks: deque[float] = deque()

    def take(self, number: int, now: float, timeout: float) -> int:
        """Look at a message's number; returns the number of recent breaks, 0 for a single publisher.

        Within a stream numbers rise. After a silence of ``timeout`` they may begin anywhere: a publisher that was
        restarted counts from one. One break is a publisher that replaced another, two are two that take turns.
        """
        passed = now - self._stamp
        if passed <= timeout and not 0 < number - self._number <= 1 + _FASTEST * (passed + _LATEST):
            self._breaks.append(now)
        self._number, self._stamp = number, now
        while self._breaks and now - self._breaks[0] > _ALONE:
            self._breaks.popleft()
        return len(self._breaks)
