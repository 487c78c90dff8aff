"""Threads that a library puts before all other programs, put back."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def left_as_they_are() -> Iterator[None]:
    """Whatever is done in the context, the threads of this process are scheduled as before, and new ones as others.

    The encoder of AV1 runs its threads and the one that opens it under SCHED_FIFO where it may, as root may, and a
    control loop on the same machine would have to wait for a video.
    """
    before = _policies()
    try:
        yield
    finally:
        for thread, policy in _policies().items():
            if policy != before.get(thread, 0):
                with suppress(OSError):  # it has ended
                    os.sched_setscheduler(thread, before.get(thread, 0), os.sched_param(0))


def _policies() -> dict[int, int]:
    """The scheduling policy of each thread; SCHED_OTHER is 0. Only told on Linux."""
    found: dict[int, int] = {}
    if sys.platform == "linux":
        for thread in map(int, (entry.name for entry in Path("/proc/self/task").iterdir())):
            with suppress(OSError):
                found[thread] = os.sched_getscheduler(thread)
    return found
