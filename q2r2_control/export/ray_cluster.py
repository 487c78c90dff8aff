"""Jobs done by a Ray cluster that is there already, in place of processes of one's own.

Its workers need this package, and see recordings and output under the same paths. A job whose worker dies is done
again by another one, so a job has to give the same when it is done twice.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from q2r2_control.errors import ConfigError

_RETRIES = 3  # of a job whose worker died
_REACHED_WITHIN = 5.0  # [s]


@contextmanager
def mapped_over(address: str, work: Callable[[Any], Any]) -> Iterator[Callable[[list[Any]], Iterator[Any]]]:
    """What ``work`` returns of jobs, in their order, done by the cluster at an ``address``.

    Raises :class:`ConfigError` where there is no such cluster or no package ray, and what ``work`` raises.
    """
    ray = _require_ray()
    _check_reachable(address)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"--ray {address}: {reason}; allowed: a running cluster, as HOST:PORT or auto") from error
    try:
        remote = ray.remote(max_retries=_RETRIES)(work)

        def run(jobs: list[Any]) -> Iterator[Any]:
            references = [remote.remote(job) for job in jobs]
            return (_result(ray, address, reference) for reference in references)

        yield run
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
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"--ray {address}: {reason}; allowed: a running cluster, as HOST:PORT or auto") from error


def _result(ray: Any, address: str, reference: Any) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"--ray {address}: a job was given up: {reason}") from error


def _require_ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise ConfigError("--ray needs ray: pip install 'q2r2_control[ray]'") from error
    return ray
