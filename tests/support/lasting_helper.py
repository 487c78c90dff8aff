"""A helper process that never ends. It starts a child, and then it either waits for ever or is always busy."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any


def main(requests: Iterator[Any], answer: Callable[[Any], None]) -> None:
    """Run the helper. The first request says whether the helper is busy. The answer is the child's process id."""
    busy = next(requests)
    # Like a forked process, the child inherits the pipe of the answers and keeps it open.
    started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"], stdout=1)
    answer(started.pid)
    while busy:
        pass
    Event().wait()
