"""What the processes beside the loop have in common, inside them."""

from __future__ import annotations

import os
import select
import signal
import sys
from contextlib import suppress
from importlib import import_module

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # for the run, which says when it has ended
LONGEST_REASON = 1000  # of a failure [bytes]
LONGEST_TOLD = 4096  # that a pipe takes at once [bytes]


def run(module: str, *arguments: int) -> None:
    """Call ``module.main`` with ``arguments``; what goes wrong is said on standard output, in one line."""
    try:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        import_module(module).main(*arguments)
    except Exception as error:
        os.write(sys.stdout.fileno(), reason_of(error).encode()[:LONGEST_REASON])


def be_nice(niceness: int) -> None:
    """Let others go first, where that is possible."""
    with suppress(OSError):
        os.nice(niceness)


def reason_of(error: BaseException) -> str:
    """One line that says what went wrong."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or repr(error)
    return " ".join(reason.split())


def has_ended(parent: int, within: float) -> bool:
    """Whether the run of process ``parent`` has ended, or does ``within`` this time [s]."""
    # Processes that the loop's has started may have the other end of the input too, and outlive it.
    return bool(select.select([sys.stdin], [], [], within)[0]) or os.getppid() != parent


def told() -> bytes:
    """What the run's end of the input said last, after :func:`has_ended`; nothing of a run that was killed."""
    ready = select.select([sys.stdin], [], [], 0.0)[0]
    return os.read(sys.stdin.fileno(), LONGEST_TOLD) if ready else b""
