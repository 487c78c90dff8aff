"""``q2r2 ros up``: the nodes of a cell as processes that live and end together."""

from __future__ import annotations

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
from dataclasses import dataclass, field

from q2r2_control.errors import Q2R2Error

# What a process gets to end itself, first by SIGINT, then by SIGTERM; the next means is SIGKILL [s].
_PATIENCE = {signal.SIGINT: 5.0, signal.SIGTERM: 3.0}


class UpError(Q2R2Error):
    """The set cannot be started; the message says what is missing."""


@dataclass(frozen=True, slots=True)
class NodeProcess:
    """One node to start: its executable's name, its module, and its parameters."""

    name: str
    module: str
    parameters: Mapping[str, str] = field(default_factory=dict)

    def command(self) -> list[str]:
        """What starts it with this Python."""
        parameters = [part for key, value in self.parameters.items() for part in ("-p", f"{key}:={value}")]
        return [sys.executable, "-u", "-m", self.module, "--ros-args", *parameters]


def nodes_of(config: str, source: str) -> list[NodeProcess]:
    """The set for a cell's YAML, with hands from ``source``: scripted, headset or none."""
    names = ["mujoco_robot", "cartesian_controller", "left_arm_controller", "right_arm_controller"]
    nodes = [NodeProcess(name, f"q2r2_control.ros.{name}", {"config": config}) for name in names]
    if source == "scripted":
        nodes.append(NodeProcess("SimulationInput", "q2r2_control.ros.simulation_input"))
    elif source == "headset":
        nodes.append(NodeProcess("tcp_endpoint", "q2r2_control.ros.tcp_endpoint", {"config": config}))
    return nodes


def run_together(nodes: Sequence[NodeProcess], say: Callable[[str], None]) -> int:
    """Start ``nodes`` and hand each line that they print to ``say``, after the node's name; the exit code.

    Ctrl-C or SIGTERM ends all of them: 0. One that ends by itself is reported at once and ends the others: 1. None is
    started again. Each is a session of its own, so that a terminal's Ctrl-C reaches it from here only, in order.
    Raises :class:`UpError`.
    """
    _check(nodes)
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()
    with _stop_requests() as stop:
        running: dict[str, subprocess.Popen[str]] = {}
        readers: list[threading.Thread] = []
        try:
            for node in nodes:
                running[node.name] = process = _start(node)
                readers.append(threading.Thread(target=_read, args=(node.name, process, lines), daemon=True))
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
    return subprocess.Popen(
        node.command(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        start_new_session=True,
    )


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
