"""Helper processes that do not end: one waits for ever beside a process that it has started, one is always busy."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any


def main(requests: Iterator[Any], answer: Callable[[Any], None]) -> None:
    """The first request says whether it is to be busy; the answer is the process that it has started."""
    busy = next(requests)
    # As a fork does, it keeps the pipe of the answers open.
    started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"], stdout=1)
    answer(started.pid)
    while busy:
        pass
    Event().wait()
