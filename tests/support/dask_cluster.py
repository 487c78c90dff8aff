"""A Dask scheduler and its workers, as processes of this computer. They listen only on 127.0.0.1."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.modules import ROOT


class DaskCluster:
    """A Dask scheduler and workers, each in its own process. :meth:`close` ends only these processes."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._processes = folder, list[subprocess.Popen[bytes]]()
        self.file = folder / "scheduler.json"
        options = ("--port", "0", "--scheduler-file", str(self.file), "--idle-timeout", "1 hour")
        _wait(self._start("dask_scheduler", *options), self.file.exists)

    @property
    def address(self) -> str:
        return str(self.file)

    @property
    def scheduler(self) -> int:
        """The id of the scheduler's process."""
        return self._processes[0].pid

    def add_workers(self, count: int = 2, threads: int = 1) -> None:
        """Start workers, and wait until the scheduler knows them. A worker that is killed does not come back."""
        from distributed import Client

        options = ["--scheduler-file", str(self.file), "--nthreads", str(threads), "--memory-limit", "1 GiB"]
        options += ["--no-nanny", "--death-timeout", "600", "--local-directory", str(self._folder)]
        with Client(scheduler_file=str(self.file), timeout=600, set_as_default=False) as client:
            known = set(client.nthreads())
            started = [self._start("dask_worker", *options) for _ in range(count)]
            for worker in started:
                _wait(worker, lambda: len(set(client.nthreads()) - known) == count)

    def close(self) -> None:
        for process in reversed(self._processes):
            process.kill()
            process.wait()

    def _start(self, module: str, *options: str) -> subprocess.Popen[bytes]:
        command = (sys.executable, "-m", f"distributed.cli.{module}", "--host", "127.0.0.1", "--no-dashboard", *options)
        # With this path, the workers find the test modules, and the packages that this process finds.
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
        with (self._folder / f"{module}-{len(self._processes)}.log").open("wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, env=environment, cwd=self._folder)
        self._processes.append(process)
        return process


def _wait(process: subprocess.Popen[bytes], condition: Callable[[], bool]) -> None:
    """Wait until ``condition`` holds, however long the process takes. Fail if the process ends before that."""
    while not condition():
        assert process.poll() is None, f"{process.args!r} ended"
        time.sleep(0.05)


@contextmanager
def dask_cluster(folder: Path, workers: int = 2) -> Iterator[DaskCluster]:
    """Start a scheduler and workers, and end them afterwards."""
    cluster = DaskCluster(folder)
    try:
        if workers:
            cluster.add_workers(workers)
        yield cluster
    finally:
        cluster.close()


def die_once(folder: Path) -> None:
    """End the calling process at once. Later calls do nothing, because a file in ``folder`` marks the first call."""
    try:
        (folder / "died").touch(exist_ok=False)
    except FileExistsError:
        return
    os.kill(os.getpid(), 9)
