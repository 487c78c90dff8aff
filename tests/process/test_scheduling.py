"""Real-time scheduling is requested as far as the system permits, and undone afterwards."""

from __future__ import annotations

import ctypes
import errno
import gc
import inspect
import os
import platform
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from q2r2_control.process.scheduling import (
    few_garbage_collections,
    real_time,
    reserve,
    schedule_thread_as_others,
    schedule_thread_first,
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only asked for on Linux")


class FakeSystem:
    """A replacement for Linux that grants only the given kinds of requests, and keeps a list of all requests."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, grants_memory: bool, grants_scheduler: bool) -> None:
        self.calls: list[tuple[object, ...]] = []
        self._grants_memory, self._grants_scheduler = grants_memory, grants_scheduler
        monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: self)
        monkeypatch.setattr(os, "sched_setscheduler", self._sched_setscheduler)

    def mlockall(self, flags: int) -> int:
        self.calls.append(("mlockall", flags))
        ctypes.set_errno(0 if self._grants_memory else errno.ENOMEM)
        return 0 if self._grants_memory else -1

    def munlockall(self) -> None:
        self.calls.append(("munlockall",))

    def _sched_setscheduler(self, thread: int, policy: int, parameters: os.sched_param) -> None:
        self.calls.append(("sched", thread, policy, parameters.sched_priority))
        if policy & os.SCHED_FIFO and not self._grants_scheduler:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


def test_if_everything_is_permitted_no_line_is_printed_and_everything_is_undone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system = FakeSystem(monkeypatch, grants_memory=True, grants_scheduler=True)
    with real_time() as refused:
        assert refused is None
        assert [call[0] for call in system.calls] == ["mlockall", "sched"]
        assert system.calls[1][1:] == (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 40)
        system.calls.clear()
    assert system.calls[0] == ("munlockall",)
    assert system.calls[-1] == ("sched", 0, os.SCHED_OTHER, 0)


def test_one_line_describes_what_the_system_refuses_and_says_how_to_permit_it(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeSystem(monkeypatch, grants_memory=False, grants_scheduler=False)
    with real_time() as refused:
        assert refused is not None
    assert refused.startswith("real time: memory is not locked: Cannot allocate memory; no SCHED_FIFO: Operation not")
    assert "\n" not in refused
    assert "the run goes on without; to permit it, " in refused


@pytest.mark.parametrize(
    ("user", "limit", "flags"),
    [
        pytest.param(1000, -1, 3, id="no limit"),
        pytest.param(1000, 8 << 20, 1, id="a limit"),
        pytest.param(0, 8 << 20, 3, id="root"),
    ],
)
def test_future_memory_is_locked_only_if_no_limit_could_refuse_it_during_the_run(
    monkeypatch: pytest.MonkeyPatch, user: int, limit: int, flags: int
) -> None:
    system = FakeSystem(monkeypatch, grants_memory=True, grants_scheduler=True)
    monkeypatch.setattr(os, "geteuid", lambda: user)
    monkeypatch.setattr("resource.getrlimit", lambda which: (limit, limit))
    with real_time():
        assert system.calls[0] == ("mlockall", flags)


def test_the_scheduling_of_the_real_system_is_restored_and_other_threads_get_no_priority() -> None:
    before = os.sched_getscheduler(0)
    policies = []
    with real_time() as refused:
        if refused is None:
            assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        thread = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
    assert policies == [before]
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == before


@pytest.mark.parametrize(("machine", "granted", "number"), [("x86_64", True, 314), ("aarch64", False, 274)])
def test_a_reservation_of_processor_time_is_requested_in_nanoseconds_and_a_refusal_is_reported(
    monkeypatch: pytest.MonkeyPatch, machine: str, granted: bool, number: int
) -> None:
    asked: list[tuple[int, int, bytes, int]] = []

    class Linux:
        def syscall(self, *arguments: int) -> int:
            asked.append(arguments)  # type: ignore[arg-type]
            return 0 if granted else -1

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: Linux())
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert reserve(0.0015, 0.002) is granted
    attributes = struct.unpack("=IIQiIQQQ", asked[0][2])
    assert (asked[0][:2], asked[0][3], len(asked)) == ((number, 0), 0, 1)
    assert attributes == (48, 6, 1, 0, 0, 1_500_000, 2_000_000, 2_000_000)


def test_a_machine_whose_system_call_is_unknown_gets_no_reservation_of_processor_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    assert not reserve(0.001, 0.002)


def test_only_the_calling_thread_gets_a_priority_and_loses_it_again(monkeypatch: pytest.MonkeyPatch) -> None:
    system = FakeSystem(monkeypatch, grants_memory=True, grants_scheduler=True)
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    assert schedule_thread_first(38) is None
    assert system.calls == [("sched", 0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 38)]
    system.calls.clear()
    schedule_thread_as_others()
    ended.set()
    assert {call[1] for call in system.calls} == {0}
    assert system.calls[-1] == ("sched", 0, os.SCHED_OTHER, 0)
    FakeSystem(monkeypatch, grants_memory=True, grants_scheduler=False)
    assert (schedule_thread_first(38) or "").startswith("no SCHED_FIFO: Operation not permitted; to permit it")


# At every line of the first signal's handler, another signal is sent, so that its handler interrupts that line.
SCRIPT = """
import os, signal, sys
from q2r2_control.process.scheduling import StopRequest
stop, sent = StopRequest(), []
def trace(frame, event, arg):
    if event == "line" and len(sent) < 20:
        sent.append(frame.f_lineno)
        os.kill(os.getpid(), signal.SIGTERM)
    return trace
signal.signal(signal.SIGTERM, lambda *_: stop.ask())
sys.settrace(trace)
stop.ask()
sys.settrace(None)
print(stop.asked, len(sent) > 0)
"""


def test_a_handler_that_interrupts_the_handler_of_another_signal_does_not_wait_for_ever() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["True", "True"], done.stderr


@pytest.fixture
def _nothing_frozen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Unfreeze the objects that tests/conftest.py has frozen, and freeze them again after the test."""
    monkeypatch.setattr(gc, "get_freeze_count", inspect.unwrap(gc.get_freeze_count))
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.mark.usefixtures("_nothing_frozen")
def test_garbage_collection_ignores_existing_objects_until_the_block_ends_or_fails() -> None:
    frozen = []

    def fail() -> None:
        with few_garbage_collections():
            frozen.append(gc.get_freeze_count())
            raise RuntimeError("the run failed")

    with pytest.raises(RuntimeError, match="the run failed"):
        fail()
    assert frozen[0] > 1000
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


@pytest.mark.usefixtures("_nothing_frozen")
def test_objects_that_a_program_has_frozen_itself_stay_frozen() -> None:
    gc.freeze()
    frozen = gc.get_freeze_count()
    with few_garbage_collections():
        assert gc.get_freeze_count() == frozen
    assert gc.get_freeze_count() == frozen
