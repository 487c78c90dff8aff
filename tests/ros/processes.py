"""Processes that a test starts; each is ended by its own id, and its output is kept for the report of a failure."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from q2r2_control.ros.launch.middleware import set_up_middleware
from tests.ros.warm_start import WarmProcess

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = "q2r2_control.ros.launch.executables"
CONFIG = "config/dual_iiwa7.yaml"
PATIENCE = 30.0  # for starting Python and discovery on an overloaded machine [s]


class RosProcess:
    """One running program, with stdout and stderr in one file."""

    def __init__(self, name: str, process: subprocess.Popen[bytes] | WarmProcess, log: Path) -> None:
        self.name, self.log, self._process = name, log, process

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def output(self) -> str:
        """All it has printed so far."""
        return self.log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def wait_for(self, text: str, timeout: float = PATIENCE) -> str:
        """The first whole line of output that contains ``text``; fails when the process ends or time runs out."""
        deadline = time.monotonic() + timeout
        while True:
            ended = not self.running  # asked before reading, so that all of its output is read
            for line in self.output.splitlines(keepends=True):
                if text in line and line.endswith("\n"):
                    return line.rstrip("\n")
            assert not ended, f"{self.name} ended with {self._process.returncode} before it said {text!r}"
            assert time.monotonic() < deadline, f"{self.name} did not say {text!r} within {timeout:g} s"
            time.sleep(0.02)

    def wait(self, timeout: float = PATIENCE) -> int:
        """Its exit code; fails when time runs out."""
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.name} did not end within {timeout:g} s") from None

    def interrupt(self, timeout: float = 10.0) -> int:
        """Ctrl-C; the exit code, or a failure when it does not end by that."""
        self._process.send_signal(signal.SIGINT)
        return self.wait(timeout)

    def end(self) -> None:
        """End it: by SIGTERM, then by SIGKILL."""
        for means in (self._process.terminate, self._process.kill):
            if self.running:
                means()
                try:
                    self._process.wait(5.0)
                except subprocess.TimeoutExpired:
                    continue


class Processes:
    """Starts processes in one environment, and ends those that are left."""

    def __init__(self, folder: Path, environment: Mapping[str, str]) -> None:
        self._folder = folder
        self._environment = dict(environment)
        self.started: list[RosProcess] = []

    def start(self, *command: str, name: str = "", **environment: str) -> RosProcess:
        """Start a program; ``environment`` is added to the private domain's."""
        log = self._new_log(name := name or Path(command[0]).name)
        with log.open("w") as output:
            process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=self._environment | environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        return self._started(name, process, log)

    def start_module(self, module: str, *arguments: str, **environment: str) -> RosProcess:
        """Start ``python -m module``, unbuffered."""
        name = arguments[0] if module == EXECUTABLES else module.split(".")[-1]
        if "LD_LIBRARY_PATH" in environment or "PYTHONPATH" in environment:  # which an interpreter reads at its start
            return self.start(sys.executable, "-u", "-m", module, *arguments, name=name, **environment)
        (log := self._new_log(name)).touch()
        process = WarmProcess([module, *arguments], ROOT, self._environment | environment, log)
        return self._started(name, process, log)

    def start_node(self, name: str, *parameters: str, **environment: str) -> RosProcess:
        """Start an executable of the package with ``parameters``, each as ``name:=value``."""
        arguments = [part for parameter in parameters for part in ("-p", parameter)]
        return self.run_node(name, *arguments, **environment)

    def run_node(self, name: str, *arguments: str, **environment: str) -> RosProcess:
        """The same with any arguments of ROS."""
        return self.start_module(EXECUTABLES, name, "--ros-args", *arguments, **environment)

    def end_all(self) -> None:
        """Last started, first ended."""
        for process in reversed(self.started):
            process.end()

    def _new_log(self, name: str) -> Path:
        return self._folder / f"{len(self.started)}-{name}.log"

    def _started(self, name: str, process: subprocess.Popen[bytes] | WarmProcess, log: Path) -> RosProcess:
        self.started.append(RosProcess(name, process, log))
        return self.started[-1]


def environment_of(domain: int, folder: Path) -> dict[str, str]:
    """This process's environment with ROS confined to ``domain`` on this machine, and its logs to ``folder``.

    Test processes use the middleware as nodes do: one that is killed must not delay others.
    """
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = dict(os.environ) | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder),
        "PYTHONPATH": os.pathsep.join(paths),
    }
    set_up_middleware(environment)
    return environment
