"""Bounds on what strangers can make the server do: a rate of anything, and of lines in the log. No clocks."""

from __future__ import annotations

import logging
from dataclasses import dataclass

LINES_PERIOD = 1.0  # between two lines about one host [s]
MAX_HOSTS_NAMED = 8  # with lines of their own within LINES_PERIOD; all others share theirs
_OTHERS = "other hosts"


class RateLimit:
    """At most ``count`` in each ``period`` [s]."""

    def __init__(self, count: int, period: float = 1.0) -> None:
        self._count, self._period = count, period
        self._start = -float("inf")
        self._taken = 0

    def is_open(self, now: float) -> bool:
        """Whether one more is allowed at ``now`` [s]."""
        return self._taken < self._count or now - self._start >= self._period

    def take(self, now: float) -> bool:
        """Count one more, if it is allowed."""
        if now - self._start >= self._period:
            self._start, self._taken = now, 0
        if self._taken >= self._count:
            return False
        self._taken += 1
        return True


@dataclass
class _Host:
    since: float  # of its last line
    level: int = 0
    text: str = ""  # the most important line held back, the newest of those
    held_back: int = 0


class HostLog:
    """Writes at most one line a second about each host.

    A line that comes too early is held back. When the second is over, the newest of the most important ones is
    written, with the number of those left out.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._hosts: dict[str, _Host] = {}

    def write(self, host: str, level: int, text: str, now: float) -> None:
        """Write, or hold back, a line about ``host``; ``level`` is one of ``logging``."""
        self.flush(now)
        if host not in self._hosts and len(self._hosts) >= MAX_HOSTS_NAMED:
            host = _OTHERS
        known = self._hosts.get(host)
        if known is None:
            self._hosts[host] = _Host(now)
            self._write(level, text)
            return
        known.held_back += 1
        if level >= known.level:
            known.level, known.text = level, text

    def flush(self, now: float) -> None:
        """Write the lines whose second is over."""
        for host, known in list(self._hosts.items()):
            if now - known.since >= LINES_PERIOD:
                del self._hosts[host]
                if known.held_back:
                    left_out = known.held_back - 1
                    self._write(known.level, known.text + (f" ({left_out} more left out)" if left_out else ""))
                    self._hosts[host] = _Host(now)

    def close(self) -> None:
        """Write all that was held back."""
        self.flush(float("inf"))

    def _write(self, level: int, text: str) -> None:
        self._logger.log(level, "%s", text)  # the text is no format: it may quote what a client sent
