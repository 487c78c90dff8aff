"""Signals and garbage collection of the process that runs a control loop, and how its helpers ended."""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class StopRequest:
    """A flag that a signal handler sets and a loop reads.

    A plain attribute: the lock of a ``threading.Event`` is not reentrant, so a signal that comes in the middle of
    another one's handler would wait for it for ever, and the process with it.
    """

    asked = False

    def ask(self) -> None:
        """Ask the loop to end."""
        self.asked = True


@contextmanager
def stop_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM call ``stop`` instead of interrupting the loop; only where this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    signals = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda *_: stop()) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, previous, strict=True):
            signal.signal(number, handler)


def how_it_ended(what: str, code: int) -> str:
    """In words, of a process ``what`` that ended with this exit ``code``, negative: by that signal."""
    return f"{what} was ended by {signal.Signals(-code).name}" if code < 0 else f"{what} ended with exit code {code}"


@contextmanager
def few_garbage_collections() -> Iterator[None]:
    """Exclude all existing objects from garbage collection, which would otherwise take several ticks each time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
