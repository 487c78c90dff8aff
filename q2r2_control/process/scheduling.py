"""Prepare the process that runs a loop: real-time scheduling and signals.

Real-time scheduling needs permissions. Without these, a run goes on with the ordinary scheduler, and reports this in
one line.
"""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import signal
import struct
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress

# Under Linux with PREEMPT_RT, interrupts have the priority 50. The loop waits for some interrupts, so that it needs a
# lower priority.
_PRIORITY = 40
LONGEST_END = 5  # Time that a process may take to end after it has closed everything. SIGALRM ends it then [s].
_CURRENT, _FUTURE = 1, 2  # Flags of mlockall on Linux.
# The system call sched_setattr of Linux: its number on each machine, and the layout of its structure, which has size,
# policy, flags, nice, priority, runtime [ns], deadline [ns] and period [ns].
_SET_ATTRIBUTES, _ATTRIBUTES = {"x86_64": 314, "aarch64": 274}, struct.Struct("=IIQiIQQQ")
_DEADLINE, _RESET_ON_FORK = 6, 1  # SCHED_DEADLINE as the policy, and the flag SCHED_FLAG_RESET_ON_FORK.
_ADVICE = (
    "to permit it, give the user 'rtprio 40' and 'memlock unlimited' in /etc/security/limits.conf and log in anew, or "
    "a container --cap-add SYS_NICE --cap-add IPC_LOCK --ulimit memlock=-1"
)


@contextmanager
def real_time(priority: int = _PRIORITY) -> Iterator[str | None]:
    """Lock the memory of the process, and let the calling thread run under SCHED_FIFO, if this is permitted.

    It yields None, or one line that says what was refused and how to permit it. Threads and processes that are started
    meanwhile do not inherit the scheduler, because a thread that draws or listens must not keep the loop waiting.
    """
    refused = [line for line in (_lock_memory(), _schedule_first([0], priority)) if line]
    try:
        yield f"real time: {'; '.join(refused)}; the run goes on without; {_ADVICE}" if refused else None
    finally:
        if sys.platform == "linux":
            ctypes.CDLL(None).munlockall()
            _schedule_as_others([0])


def reserve(runtime: float, period: float) -> bool:
    """Reserve ``runtime`` [s] of a processor in every ``period`` [s] for the calling thread, before all other threads.

    If threads under SCHED_FIFO leave no time for other programs, Linux halts them for up to 50 ms. A reservation
    (SCHED_DEADLINE) has precedence over this halt. A thread that needs more time waits for its next period.

    Returns:
        False if the system has no such reservations, or does not permit one. Nothing has changed then.
    """
    number = _SET_ATTRIBUTES.get(platform.machine()) if sys.platform == "linux" else None
    if number is None:
        return False
    nanoseconds = round(1e9 * runtime), round(1e9 * period), round(1e9 * period)
    attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, _DEADLINE, _RESET_ON_FORK, 0, 0, *nanoseconds)
    return bool(ctypes.CDLL(None, use_errno=True).syscall(number, 0, attributes, 0) == 0)


def schedule_thread_first(priority: int) -> str | None:
    """Let the calling thread run under SCHED_FIFO at ``priority``, from 1 to 99.

    Other threads of the process keep their scheduler. Threads and processes that are started later do not inherit the
    scheduler of this thread.

    Returns:
        None, or one line that says why it is not permitted and how to permit it.
    """
    refused = _schedule_first([0], priority)
    return refused if refused is None or sys.platform != "linux" else f"{refused}; {_ADVICE}"


def thread_priority() -> int:
    """Return the priority of the calling thread under SCHED_FIFO; 0 if it has an ordinary scheduler."""
    return os.sched_getparam(0).sched_priority if sys.platform == "linux" else 0


def schedule_thread_as_others() -> None:
    """Undo :func:`schedule_thread_first`."""
    _schedule_as_others([0])


def _lock_memory() -> str | None:
    """Lock the memory; returns why this is not possible, or None."""
    if sys.platform != "linux":
        return "memory is not locked: only done on Linux"
    import resource  # The import is here, because not every system has this module.

    # If the size of locked memory is limited, the flag _FUTURE would let later requests for memory fail during the run.
    # Without this flag, such memory is merely not locked.
    unlimited = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if ctypes.CDLL(None, use_errno=True).mlockall(_CURRENT | _FUTURE if unlimited else _CURRENT) == 0:
        return None
    return f"memory is not locked: {os.strerror(ctypes.get_errno())}"


def _schedule_first(threads: Iterable[int], priority: int) -> str | None:
    """Let threads run under SCHED_FIFO; returns why this is not possible, or None. 0 is the calling thread."""
    if sys.platform != "linux":
        return "no SCHED_FIFO: only asked for on Linux"
    try:
        for thread in threads:
            with suppress(ProcessLookupError):  # The call fails if the thread has ended meanwhile.
                os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        return f"no SCHED_FIFO: {error.strerror}"
    return None


def _schedule_as_others(threads: Iterable[int]) -> None:
    # Only a privileged process may take back the flag RESET_ON_FORK. Other processes keep it, without further effect.
    for thread in threads:
        for policy in (os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.SCHED_OTHER):
            with suppress(OSError):
                os.sched_setscheduler(thread, policy, os.sched_param(0))


class StopRequest:
    """A flag that a signal handler sets and a loop reads.

    The flag is a plain attribute, because a ``threading.Event`` has a lock. If a second signal interrupted a handler
    that holds this lock, the handler of the second signal would wait for ever.
    """

    asked = False

    def ask(self) -> None:
        """Ask the loop to end."""
        self.asked = True


@contextmanager
def stop_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM call ``stop`` instead of interrupting the loop, if this is the main thread."""
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
    """Return in words how a process ``what`` has ended. A negative exit ``code`` is the number of a signal."""
    return f"{what} was ended by {signal.Signals(-code).name}" if code < 0 else f"{what} ended with exit code {code}"


@contextmanager
def few_garbage_collections() -> Iterator[None]:
    """Exclude all existing objects from garbage collection. A collection of all objects would take several ticks.

    If the program has already frozen objects itself, they stay frozen, and this function does nothing.
    """
    if gc.get_freeze_count():
        yield
        return
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
