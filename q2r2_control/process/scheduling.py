"""What an operating system does for a loop that must not be late: memory stays in RAM, and its threads go first.

Both need a permission. Without it a run goes on as it would have, so what was refused is a line and no error.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

# Below 50, at which Linux with PREEMPT_RT runs the interrupts that the loop itself waits for.
_PRIORITY = 40
_ONLY_LINUX = "no SCHED_FIFO: only asked for on Linux"
_CURRENT, _FUTURE = 1, 2  # of mlockall on Linux
_ADVICE = (
    "to permit it, give the user 'rtprio 40' and 'memlock unlimited' in /etc/security/limits.conf and log in anew, or "
    "a container --cap-add SYS_NICE --cap-add IPC_LOCK --ulimit memlock=-1"
)


@contextmanager
def real_time() -> Iterator[str | None]:
    """Lock the process's memory and let the calling thread run under SCHED_FIFO, as far as that is permitted.

    Yields None, or one line that says what was refused and how to permit it. Threads and processes that are started
    meanwhile do not inherit the scheduler: one that draws or listens must not keep the loop waiting.
    """
    refused = [line for line in (_lock_memory(), _schedule_first()) if line]
    try:
        yield f"real time: {'; '.join(refused)}; the run goes on without; {_ADVICE}" if refused else None
    finally:
        _unlock_memory()
        _schedule_as_others()


def schedule_process_first(priority: int) -> str | None:
    """Let all threads that this process has now run under SCHED_FIFO at ``priority``, 1..99.

    For a process whose other threads bring and take what its loop waits for. Returns None, or one line that says why
    that is not permitted, and how to permit it. Threads and processes that are started later do not inherit it.
    """
    if sys.platform != "linux":
        return _ONLY_LINUX
    scheduler, parameters = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority)
    try:
        for thread in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setscheduler(int(thread.name), scheduler, parameters)
    except OSError as error:
        return f"no SCHED_FIFO: {error.strerror}; {_ADVICE}"
    return None


def schedule_process_as_others() -> None:
    """Take back what :func:`schedule_process_first` did."""
    if sys.platform == "linux":
        for thread in Path("/proc/self/task").iterdir():
            _schedule_as_others(int(thread.name))


def _lock_memory() -> str | None:
    """Why memory cannot be locked, or None."""
    if sys.platform != "linux":
        return "memory is not locked: only done on Linux"
    import resource  # not on every system

    flags = _CURRENT
    # Under a limit, memory that is asked for later would be refused in mid-run instead of being left unlocked.
    if os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY:
        flags |= _FUTURE
    if ctypes.CDLL(None, use_errno=True).mlockall(flags) == 0:
        return None
    return f"memory is not locked: {os.strerror(ctypes.get_errno())}"


def _unlock_memory() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).munlockall()


def _schedule_first() -> str | None:
    """Why the calling thread does not get SCHED_FIFO, or None."""
    if sys.platform != "linux":
        return _ONLY_LINUX
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    except OSError as error:
        return f"no SCHED_FIFO: {error.strerror}"
    return None


def _schedule_as_others(thread: int = 0) -> None:
    """Of a thread of this process; 0: the calling one."""
    if sys.platform != "linux":
        return
    # Only a privileged process may take the flag back; others keep it, where it does nothing more.
    with suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    with suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
