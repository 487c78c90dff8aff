"""Processes that a test starts and ends by their ids. The report of a failed test contains their output.

To import a node takes one to two seconds of processor time, and a test of a whole set starts five nodes. Nodes are
therefore forked from a server that has imported all modules once, before ROS is initialised. A forked process then runs
the same code as ``python -m`` does.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from queue import Queue
from typing import Any

from q2r2_control.ros.launch.middleware import set_up_middleware

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = "q2r2_control.ros.launch.executables"
CONFIG = "config/dual_iiwa7.yaml"
PATIENCE = 30.0  # Timeout for the start of Python and for discovery on an overloaded machine [s].
_NODES = ("cartesian_controller", "mujoco_robot", "arm_controllers", "tcp_endpoint", "simulation_input")
multiprocessing.get_context("forkserver").set_forkserver_preload([f"q2r2_control.ros.nodes.{name}" for name in _NODES])


class WarmProcess(ForkServerProcess):
    """A forked process with the methods of :class:`subprocess.Popen`."""

    def poll(self) -> int | None:
        return self.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self.join(timeout)
        if self.exitcode is None:
            raise subprocess.TimeoutExpired("", timeout or 0.0)
        return self.exitcode

    def send_signal(self, number: int) -> None:
        if self.exitcode is None and self.pid is not None:
            os.kill(self.pid, number)


def _run(command: list[str], environment: dict[str, str], log: str) -> None:
    """Run in the new process, as if an interpreter had been started with this environment and this output."""
    output = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", 1), os.fdopen(2, "w", 1)
    os.chdir(ROOT)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = list(command)
    sys.modules.pop(command[0], None)  # The module runs anew, under the name __main__.
    runpy.run_module(command[0], run_name="__main__", alter_sys=True)


class RosProcess:
    def __init__(self, name: str, process: subprocess.Popen[bytes] | WarmProcess, log: Path) -> None:
        self.name, self.log, self._process = name, log, process
        self.pid: int = process.pid or 0

    @property
    def output(self) -> str:
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def wait_for(self, text: str, timeout: float = PATIENCE) -> str:
        """Return the first whole line of output that contains ``text``. Fails if the process ends or time runs out."""
        deadline = time.monotonic() + timeout
        while True:
            # Whether the process has ended is found out before its output is read, so that no output is missed.
            ended = not self.running
            for line in self.output.splitlines(keepends=True):
                if text in line and line.endswith("\n"):
                    return line.rstrip("\n")
            assert not ended, f"{self.name} ended with {self._process.poll()} before it said {text!r}"
            assert time.monotonic() < deadline, f"{self.name} did not say {text!r} within {timeout:g} s"
            time.sleep(0.02)

    def wait(self, timeout: float = PATIENCE) -> int:
        """Return the exit code. Fails if time runs out."""
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.name} did not end within {timeout:g} s") from None

    def interrupt(self, timeout: float = 10.0) -> int:
        self._process.send_signal(signal.SIGINT)
        return self.wait(timeout)

    def end(self) -> None:
        for means in (self._process.terminate, self._process.kill):
            if self.running:
                means()
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(5.0)


class Processes:
    """Starts processes in one environment, and ends those that remain."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder, self._environment = folder, dict(environment)
        self.started: list[RosProcess] = []

    def start(self, *command: str, name: str = "", **environment: str) -> RosProcess:
        """Start a program; ``environment`` is added to the environment of the private domain."""
        log = self._folder / f"{len(self.started)}-{name or Path(command[0]).name}.log"
        given = {"cwd": ROOT, "env": self._environment | environment, "stdin": subprocess.DEVNULL}
        with log.open("w") as output:
            process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, **given)  # type: ignore[call-overload]
        self.started.append(RosProcess(name, process, log))
        return self.started[-1]

    def start_module(self, module: str, *arguments: str) -> RosProcess:
        """Start ``python -m module``."""
        name = arguments[0] if module == EXECUTABLES else module.split(".")[-1]
        (log := self._folder / f"{len(self.started)}-{name}.log").touch()
        process = WarmProcess(target=_run, args=([module, *arguments], self._environment, str(log)))
        process.start()
        self.started.append(RosProcess(name, process, log))
        return self.started[-1]

    def start_node(self, name: str, *parameters: str, node: str = "") -> RosProcess:
        """Start an executable with ``parameters``, each as ``name:=value``; ``node`` is another name for its node."""
        remapping = ["-r", f"__node:={node}"] if node else []
        return self.start_module(EXECUTABLES, name, *as_arguments(*parameters), *remapping)

    def end_all(self) -> None:
        for process in reversed(self.started):
            process.end()


def as_arguments(*parameters: str) -> list[str]:
    """Return the parameters as arguments of a node's command line."""
    return ["--ros-args", *(part for parameter in parameters for part in ("-p", parameter))]


def environment_of(domain: int, folder: Path) -> dict[str, str]:
    """Return an environment for nodes with ROS confined to ``domain`` on this machine, and with logs in ``folder``."""
    environment = dict(os.environ) | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder),
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    set_up_middleware(environment)
    return environment


def wait_until(
    condition: Callable[[], object], what: str, details: Callable[[], object] | None = None, patience: float = PATIENCE
) -> None:
    """Wait until ``condition`` holds. Fail with ``what`` and ``details`` after ``patience`` [s], a generous time."""
    deadline = time.monotonic() + patience
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {patience:g} s: {what}" + (f"; {details()}" if details else ""))
        time.sleep(0.002)


def call(node: Any, service: str, request: Any = None) -> Any:
    """Return the response of a Trigger service, or of a SetBool service for ``request``.

    Another thread spins ``node``.
    """
    from std_srvs.srv import SetBool, Trigger

    client = node.create_client(Trigger if request is None else SetBool, service)
    try:
        wait_until(client.service_is_ready, f"{service} is there")
        future = client.call_async(Trigger.Request() if request is None else request)
        wait_until(future.done, f"{service} answers")
        return future.result()
    finally:
        node.destroy_client(client)


def drained(queue: Queue[Any]) -> list[Any]:
    return [queue.get() for _ in range(queue.qsize())]


def subscribed(node: Any, kind: type, topic: str, qos: Any = 100) -> Queue[Any]:
    """Collect the messages that come on a topic from now on."""
    messages: Queue[Any] = Queue()
    node.create_subscription(kind, topic, messages.put, qos)
    return messages


class States:
    """Listens to a node's ``~/state``."""

    def __init__(self, node: Any, name: str) -> None:
        from std_msgs.msg import String

        self._states = subscribed(node, String, f"/{name}/state")

    def wait_for(self, **values: Any) -> dict[str, Any]:
        """Return the first state from now on that has these values."""
        drained(self._states)
        deadline = time.monotonic() + PATIENCE
        while True:
            state: dict[str, Any] = json.loads(self._states.get(timeout=PATIENCE).data)
            if values.items() <= state.items():
                return state
            assert time.monotonic() < deadline, f"no state with {values}, the last was {state}"
