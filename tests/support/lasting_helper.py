"""Helper processes that do not end: one waits for ever beside its child, and one is always busy."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any


def main(requests: Iterator[Any], answer: Callable[[Any], None]) -> None:
    """Run the helper. The first request says whether it is busy, and the answer is the id of its child."""
    busy = next(requests)
    # Like a fork, the child keeps the pipe of the answers open.
    started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"], stdout=1)
    answer(started.pid)
    while busy:
        pass
    Event().wait()
