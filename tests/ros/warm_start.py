"""Runs modules as processes of their own that need not import again what every node needs.

A node takes one to two seconds of a processor to import, and a test of a whole set starts five. They are forked from a
server that has imported it all once, before any of ROS is initialised; what runs then is what ``python -m`` runs.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

_NODES = ("cartesian_controller", "mujoco_robot", "arm_controllers", "tcp_endpoint", "simulation_input")
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload([f"q2r2_control.ros.nodes.{name}" for name in _NODES])


class WarmProcess:
    """What :class:`subprocess.Popen` offers, for ``python -u -m module arguments``."""

    def __init__(self, command: Sequence[str], cwd: Path, environment: Mapping[str, str], log: Path) -> None:
        """``command``: the module and its arguments; ``log``: where stdout and stderr go."""
        self._process = _CONTEXT.Process(target=_run, args=(list(command), str(cwd), dict(environment), str(log)))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code. Raises :class:`subprocess.TimeoutExpired`."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("", timeout or 0.0)
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


def _run(command: list[str], cwd: str, environment: dict[str, str], log: str) -> None:
    """In the new process: as if an interpreter had been started with this environment, here, with this output."""
    output = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", 1), os.fdopen(2, "w", 1)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    module, *arguments = command
    sys.argv = [module, *arguments]
    sys.modules.pop(module, None)  # it runs as __main__
    runpy.run_module(module, run_name="__main__", alter_sys=True)
