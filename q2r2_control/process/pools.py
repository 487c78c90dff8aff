"""Make pools of worker processes, which end when the process that made the pool ends."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from threading import Thread


def pool_of(workers: int) -> ProcessPoolExecutor:
    """Return a pool of ``workers`` processes. They are spawned, not forked, because this process may have threads.

    Ctrl-C in a terminal reaches all processes. The workers ignore it, because this process ends them.
    """
    return ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Let a worker end with its parent. Otherwise it would wait for work for ever."""
    if (parent := parent_process()) is not None:
        parent.join()
        os._exit(1)
