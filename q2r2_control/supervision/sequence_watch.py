"""Whether a single publisher sends a stream, by the sequence numbers of its messages.

The ROS graph cannot tell: it counts a killed publisher for some seconds more.
"""

from __future__ import annotations

import math
from collections import deque

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
