"""A process beside the loop is ended when it hangs, and not because a busy machine let it wait."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from q2r2_control.recording.helper_process import HelperProcess
from q2r2_control.recording.ring import new_memory

LATE = "it hangs"
WORK = 0.02  # of a processor's time [s]
PATIENCE = 0.3  # [s]


def main(memory: int, parent: int) -> None:
    """Say that it has begun; once it is told to end, work for a while, or for ever sleep where that is asked for."""
    sleeps = os.pread(memory, 1, 0) == b"s"
    os.pwrite(memory, b"!", 1)
    sys.stdin.read()
    if sleeps:
        time.sleep(3600.0)
    begun = time.process_time()
    while time.process_time() - begun < WORK:
        pass


def helper(what: bytes) -> HelperProcess:
    """One that has begun, and says no more of how it gets on."""
    memory = new_memory(8)
    try:
        os.pwrite(memory, what, 0)
        process = HelperProcess("tests", __name__, (memory,), lambda: [1])
        while os.pread(memory, 1, 1) != b"!":
            assert process.alive, process.fault()
            time.sleep(1e-3)
    finally:
        os.close(memory)
    return process


def test_one_that_sleeps_is_late() -> None:
    process = helper(b"s")
    try:
        assert process.last_words(PATIENCE, LATE) == LATE
    finally:
        process.end()
    assert not process.alive


def test_one_that_waits_for_a_processor_is_not_late_however_long_that_takes() -> None:
    process = helper(b"w")
    processor = min(os.sched_getaffinity(0))
    # Its work takes seventy times as long beside this one.
    busy = subprocess.Popen([sys.executable, "-c", "print(flush=True)\nwhile True: pass"], stdout=subprocess.PIPE)
    try:
        assert busy.stdout is not None
        busy.stdout.readline()  # from now on it is
        for pid in (busy.pid, process.pid):
            os.sched_setaffinity(pid, {processor})
        os.setpriority(os.PRIO_PROCESS, process.pid, 19)
        began = time.monotonic()
        assert process.last_words(PATIENCE, LATE) is None
        assert time.monotonic() - began > PATIENCE, "the test, it had a processor"
    finally:
        busy.kill()
        busy.communicate()
        process.end()
