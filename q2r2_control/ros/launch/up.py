"""``q2r2 ros up``: the nodes of a cell as processes that live and end together."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from q2r2_control.errors import Q2R2Error
from q2r2_control.ros.launch.node_set import NodeProcess

# What a process gets to end itself, first by SIGINT, then by SIGTERM; the next means is SIGKILL [s].
_PATIENCE = {signal.SIGINT: 5.0, signal.SIGTERM: 3.0}
# Looked up here, since little is safe between fork and exec.
_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
_PR_SET_PDEATHSIG = 1


class UpError(Q2R2Error):
    """The set cannot be started; the message says what is missing."""


def run_together(nodes: Sequence[NodeProcess], say: Callable[[str], None]) -> int:
    """Start ``nodes`` and hand each line that they print to ``say``, after the node's name; the exit code.

    Ctrl-C or SIGTERM ends all of them: 0. One that ends by itself is reported at once and ends the others: 1. None is
    started again. Each is a session of its own, so that a terminal's Ctrl-C reaches it from here only, in order.
    Where this process is killed, Linux interrupts them all: arms must not move for a teleoperation nobody can end.
    Raises :class:`UpError`.
    """
    _check(nodes)
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    with _stop_requests() as stop:
        running: dict[str, subprocess.Popen[str]] = {}
        readers: list[threading.Thread] = []
        try:
            for node in nodes:
                running[node.name] = _start(node)
            for name, process in running.items():  # threads come last, since a process is forked from one thread best
                readers.append(threading.Thread(target=_read, args=(name, process, lines), daemon=True))
                readers[-1].start()
            dead = _watch(running, stop, lines, say)
        finally:
            _end(running, lines, say)
            for reader in readers:
                reader.join(1.0)
            _drain(lines, say)
    if dead is not None:
        say(f"[up] {dead} ended by itself; all others have been stopped")
        return 1
    say("[up] all stopped")
    return 0


def _check(nodes: Sequence[NodeProcess]) -> None:
    if importlib.util.find_spec("rclpy") is None:
        raise UpError("rclpy cannot be imported: pip install 'q2r2_control[ros]', or source a ROS 2 Jazzy")
    missing = [node.module for node in nodes if importlib.util.find_spec(node.module) is None]
    if missing:
        raise UpError(f"no such module: {', '.join(missing)}")


def _start(node: NodeProcess) -> subprocess.Popen[str]:
    parent = os.getpid()
    return subprocess.Popen(
        node.command(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        start_new_session=True,
        preexec_fn=None if _prctl is None else lambda: _end_with(parent),
    )


def _end_with(parent: int) -> None:
    """In the new process: be interrupted when ``parent`` ends, which it may have done already."""
    assert _prctl is not None
    _prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGINT)


def _read(name: str, process: subprocess.Popen[str], lines: queue.SimpleQueue[str]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        lines.put(f"[{name}] {line.rstrip()}")


def _watch(
    running: Mapping[str, subprocess.Popen[str]],
    stop: threading.Event,
    lines: queue.SimpleQueue[str],
    say: Callable[[str], None],
) -> str | None:
    """Wait for the request to stop, or for a process to end by itself; its name."""
    while not stop.is_set():
        _drain(lines, say)
        for name, process in running.items():
            if (code := process.poll()) is not None:
                how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
                say(f"[up] {name} (process {process.pid}) ended {how}; stopping all others")
                return name
        time.sleep(0.02)
    return None


def _end(
    running: Mapping[str, subprocess.Popen[str]], lines: queue.SimpleQueue[str], say: Callable[[str], None]
) -> None:
    """Last started, first ended, one after the other: the robot is there until the controller has braked it."""
    for process in reversed(list(running.values())):
        for number, patience in _PATIENCE.items():
            if process.poll() is None:
                process.send_signal(number)
            deadline = time.monotonic() + patience
            while process.poll() is None and time.monotonic() < deadline:
                _drain(lines, say)
                time.sleep(0.02)
    for name, process in running.items():
        if process.poll() is None:
            say(f"[up] {name} (process {process.pid}) did not end and is killed")
            process.kill()
            process.wait()


def _drain(lines: queue.SimpleQueue[str], say: Callable[[str], None]) -> None:
    while not lines.empty():
        say(lines.get())


@contextmanager
def _stop_requests() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set."""
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, previous, strict=True):
            signal.signal(number, handler)
