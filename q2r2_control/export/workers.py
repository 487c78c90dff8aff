"""Who does the jobs of an export: this process, several ones, or a Ray cluster that is there already.

Each way is a context that gives a function from jobs to their results, in the order of the jobs. The workers of a
cluster need this package, and see recordings and output under the same paths. A job whose worker dies is done again by
another one, and has to give the same when it is done twice.
"""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from q2r2_control.errors import ConfigError

Work = Callable[[Any], Any]  # does one job
Run = Callable[[Sequence[Any]], Iterable[Any]]

_RETRIES = 3  # of a job whose worker died
_REACHED_WITHIN = 5.0  # [s]
_ALLOWED = "allowed: a running cluster, as HOST:PORT or auto"


@contextmanager
def here(work: Work) -> Iterator[Run]:
    """One job after the other."""
    yield lambda jobs: map(work, jobs)


@contextmanager
def in_processes(count: int, work: Work) -> Iterator[Run]:
    """Jobs shared by ``count`` processes. Raises :class:`ConfigError` where one is killed, and what ``work`` raises."""
    # Spawned, not forked: this process may have threads. Ctrl-C reaches all of them, and this process ends the others.
    ignored = (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=signal.signal, initargs=ignored)

    def run(jobs: Sequence[Any]) -> Iterable[Any]:
        try:
            return pool.map(work, jobs)
        except OSError as error:  # "handle is closed", of a pool that breaks while it is given its jobs
            raise BrokenProcessPool from error

    try:
        yield run
    except BrokenProcessPool as error:
        raise ConfigError(
            "a process of --workers was killed, as for want of memory; the same command goes on with what is made"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def on_ray(address: str, work: Work) -> Iterator[Run]:
    """Jobs done by the cluster at an ``address``.

    Raises :class:`ConfigError` where there is no such cluster or no package ray, and what ``work`` raises.
    """
    ray = _require_ray()
    _check_reachable(address)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise ConfigError(f"--ray {address}: {_line(error)}; {_ALLOWED}") from error
    remote = ray.remote(max_retries=_RETRIES)(work)

    def result(reference: Any) -> Any:
        try:
            return ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except ray.exceptions.RayError as error:
            raise ConfigError(f"--ray {address}: a job was given up: {_line(error)}") from error

    try:
        yield lambda jobs: map(result, [remote.remote(job) for job in jobs])
    finally:
        # The cluster drops what is left of a program that goes. Ray's own cancel aborts this one, where a task ends
        # just then (ray 2.60).
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Ray itself tries for minutes. Raises :class:`ConfigError`."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), _REACHED_WITHIN).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(f"--ray {address}: {getattr(error, 'strerror', None) or error}; {_ALLOWED}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _require_ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ConfigError("--ray needs ray: pip install 'q2r2_control[ray]'") from error
    return ray
