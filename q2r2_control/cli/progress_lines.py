"""How far a long search has got, in plain lines now and then, for terminals and for logs."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.console import Console


class ProgressLines:
    """Prints a line when the last one is ``period`` seconds old; what is done sooner than that prints none."""

    def __init__(self, console: Console, period: float = 3.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._period, self._clock = console, period, clock
        self._due = clock() + period

    def __call__(self, what: str, done: int, total: int) -> None:
        """``done`` of ``total`` are through with ``what``."""
        if (now := self._clock()) >= self._due:
            self._due = now + self._period
            self._console.print(f"{what}: {done:,} of {total:,}", highlight=False, soft_wrap=True)
