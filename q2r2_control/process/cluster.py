"""Runs jobs on the workers of a dask.distributed scheduler, which the user has started."""

from __future__ import annotations

import gc
import logging
import os
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar
from uuid import uuid4

from q2r2_control.errors import ConfigError
from q2r2_control.extras import install_line
from q2r2_control.process.cluster_worker import Call, Needs, hash_of_sources, look

_CONNECT_S = 20.0  # Longest time to connect to the scheduler [s].
_LOOK_S = 2.0  # While no job finishes, time between two checks whether any worker is left [s].
# Packages whose versions can change the numbers in results.
_COMPARED = (
    *("q2r2_control", "dask", "distributed", "numpy", "scipy", "pin", "numba", "daqp", "osqp", "qpsolvers"),
    *("mujoco", "pillow", "mcap", "zstandard", "h5py", "pyarrow", "av", "lerobot"),
)

Job = TypeVar("Job")
Result = TypeVar("Result")

_logger = logging.getLogger(__name__)


class Cluster:
    """The workers of a scheduler as a :class:`~q2r2_control.process.places.JobPlace`.

    The scheduler gives the jobs of a killed worker to another worker. A job whose result has arrived is not done again.
    """

    def __init__(self, address: str) -> None:
        """Take the ``address`` of a scheduler, or the path of its file. Raises :class:`ConfigError` without dask."""
        try:
            import distributed
        except ImportError as error:
            raise ConfigError(f"--cluster needs dask.distributed: {install_line('cluster')}") from error
        _silence()
        self._distributed: Any = distributed
        self._address = address
        self._done: Counter[str] = Counter()

    @property
    def where(self) -> str:
        """Return how many jobs each machine has done, such as " (node01: 12, node02: 11)"."""
        counts = ", ".join(f"{machine}: {count}" for machine, count in sorted(self._done.items()))
        return f" ({counts})" if counts else ""

    def results(
        self,
        work: Callable[[Job], Result],
        jobs: Sequence[Job],
        reads: Callable[[Job], Path] | None = None,
        writes: Path | None = None,
    ) -> Generator[Result]:
        """Yield the results; see :class:`~q2r2_control.process.places.JobPlace`.

        All workers are compared with this computer before the first job begins.
        """
        if not jobs:
            return
        with self._client() as client, _probe(writes) as probe:
            needs = [self._needs(None if reads is None else reads(job), probe) for job in jobs]
            files = tuple(dict.fromkeys(file for its in needs for file in its.files))
            self._compare(client, Needs(needs[0].sources, needs[0].folder, files, probe), work)
            yield from self._run(client, [Call(work, job, its) for job, its in zip(jobs, needs, strict=True)])

    @contextmanager
    def _client(self) -> Iterator[Any]:
        where = {"scheduler_file": self._address} if os.path.isfile(self._address) else {"address": self._address}
        client = None
        with suppress(OSError, ValueError, TypeError, KeyError, AssertionError):
            client = self._distributed.Client(**where, timeout=_CONNECT_S, set_as_default=False)
        if client is None:
            # The client that could not connect has to be deleted now, because it closes itself when it is deleted. At
            # the end of the program, dask's thread would have ended: the client would wait for 40 s and print a
            # traceback. dask's exception would keep the client alive, so the exception is not kept as a cause.
            gc.collect()
            raise self._error(
                "no scheduler answers there; allowed: its address, such as tcp://node01:8786, or its file"
            )
        with client:
            yield client

    def _needs(self, file: Path | None, probe: str | None) -> Needs:
        if file is None:
            return Needs(hash_of_sources(), probe=probe)
        path = file.absolute()
        return Needs(hash_of_sources(), os.getcwd(), ((str(path), path.stat().st_size),), probe)

    def _compare(self, client: Any, needs: Needs, work: Callable[[Any], Any]) -> None:
        """Raise :class:`ConfigError` if a worker has other versions or files, or does several jobs at the same time."""
        threads = client.nthreads()
        if not threads:
            raise self._error("it has no workers; start some: dask worker ADDRESS --nthreads 1")
        for worker, count in threads.items():
            if count != 1:
                raise self._error(f"worker {worker} does {count} jobs at once in one process; allowed: --nthreads 1")
        versions = client.get_versions(packages=_COMPARED)
        here = versions["client"]
        for worker, its in versions["workers"].items():
            if (fault := _other_version(here, its)) is not None:
                raise self._error(f"worker {worker} has {fault}; allowed: the same on all machines")
        for worker, fault in client.run(look, needs, work, on_error="return").items():
            if isinstance(fault, Exception):
                if worker not in client.nthreads():
                    continue  # The worker has ended during the comparison. Others do its jobs.
                fault = f"cannot import the work: {' '.join(str(fault).split())}"
            if fault is not None:
                raise self._error(f"worker {worker}: {fault}")

    def _run(self, client: Any, calls: Sequence[Call]) -> Generator[Any]:
        executor = client.get_executor(pure=False)
        finished: SimpleQueue[int] = SimpleQueue()
        waiting: dict[int, Future[tuple[str, Any]]] = {}
        try:
            for number, call in enumerate(calls):
                waiting[number] = executor.submit(call)
                waiting[number].add_done_callback(partial(_tell, finished, number))
            outcomes: dict[int, tuple[Any, BaseException | None]] = {}
            for due in range(len(calls)):
                while due not in outcomes:
                    number = self._next(client, finished)
                    # The future is dropped as soon as its result is read. Otherwise, the scheduler might repeat the job
                    # if the worker with the result ends.
                    outcomes[number] = self._outcome(waiting.pop(number))
                result, error = outcomes.pop(due)
                if error is not None:
                    raise error
                yield result
        finally:
            executor.shutdown(wait=False)

    def _next(self, client: Any, finished: SimpleQueue[int]) -> int:
        """Return the number of the next job that has ended. If no worker is left meanwhile, log one line."""
        told = False
        while True:
            try:
                return finished.get(timeout=_LOOK_S)
            except Empty:
                if client.status != "running":
                    raise self._lost() from None
                if not told and not client.nthreads():
                    _logger.warning("--cluster %s: no worker is left; the jobs wait for another one", self._address)
                    told = True

    def _outcome(self, future: Future[tuple[str, Any]]) -> tuple[Any, BaseException | None]:
        try:
            machine, result = future.result()
        except CancelledError:
            return None, self._lost()
        except Exception as error:
            if type(error).__name__ != "KilledWorker":
                return None, error
            return None, self._error("a job ended several workers one after the other, as for want of memory")
        self._done[machine] += 1
        return result, None

    def _lost(self) -> ConfigError:
        return self._error("the scheduler is gone; the same command begins again, with what is made")

    def _error(self, what: str) -> ConfigError:
        return ConfigError(f"--cluster {self._address}: {what}")


def _tell(finished: SimpleQueue[int], number: int, future: Future[Any]) -> None:
    finished.put(number)


def _other_version(here: Any, there: Any) -> str | None:
    """Return a text about the first version of a worker that differs from ours, or None if all versions are equal.

    ``here`` and ``there`` are dask's descriptions of this process and of the worker.
    """
    ours, its = here["host"]["python"], there["host"]["python"]
    if ours != its:
        return f"Python {its}, and here is {ours}"
    for name in _COMPARED:
        ours, its = here["packages"].get(name), there["packages"].get(name)
        if ours != its:
            return f"{f'{name} {its}' if its else f'no {name}'}, and here is {ours or 'none'}"
    return None


@contextmanager
def _probe(folder: Path | None) -> Iterator[str | None]:
    """Make a file in ``folder``, and remove it afterwards. A worker that sees this file has the same folder."""
    if folder is None:
        yield None
        return
    probe = folder.absolute() / f".probe-{uuid4().hex}"
    probe.touch()
    try:
        yield str(probe)
    finally:
        probe.unlink(missing_ok=True)


def _silence() -> None:
    """Keep dask's log and warnings off the terminal, because this package reports each fault in one line."""
    warnings.filterwarnings("ignore", module=r"distributed(\..*)?")
    for name in tuple(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)
