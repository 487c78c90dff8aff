"""Decide where independent jobs run: in this process, in processes of this computer, or on machines of a cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children
from pathlib import Path
from typing import Protocol, TypeVar

from q2r2_control.errors import ConfigError
from q2r2_control.process.pools import pool_of

Job = TypeVar("Job")
Result = TypeVar("Result")


class JobPlace(Protocol):
    """A place where jobs run."""

    @property
    def where(self) -> str:
        """Return a text for lines of progress: how many jobs each machine has done, or "" on this computer."""

    def results(
        self,
        work: Callable[[Job], Result],
        jobs: Sequence[Job],
        reads: Callable[[Job], Path] | None = None,
        writes: Path | None = None,
    ) -> Generator[Result]:
        """Yield the results of ``work`` for all ``jobs``, in the order of the jobs. Every place gives the same results.

        Args:
            work: A function at the top level of a module, or a ``functools.partial`` of one. Other processes import it.
            jobs: The arguments of the calls.
            reads: Returns the file that a job reads; None if jobs read no files.
            writes: The folder into which jobs write; None if they write no files.

        Raises:
            ConfigError: If a process that does the work was killed, or if a machine cannot do it.
            Exception: The error of the first job that raises one.
        """


class ThisProcess:
    """Runs jobs one after the other in this process."""

    where = ""

    def results(
        self,
        work: Callable[[Job], Result],
        jobs: Sequence[Job],
        reads: Callable[[Job], Path] | None = None,
        writes: Path | None = None,
    ) -> Generator[Result]:
        """Yield the results; see :class:`JobPlace`."""
        yield from map(work, jobs)


HERE = ThisProcess()


@dataclass(frozen=True)
class Processes:
    """Runs jobs in at most ``most`` processes of this computer. If the caller stops early, the processes are killed."""

    most: int
    where = ""

    def results(
        self,
        work: Callable[[Job], Result],
        jobs: Sequence[Job],
        reads: Callable[[Job], Path] | None = None,
        writes: Path | None = None,
    ) -> Generator[Result]:
        """Yield the results; see :class:`JobPlace`."""
        if not jobs:
            return
        others = active_children()
        pool = pool_of(min(self.most, len(jobs)))
        try:
            yield from pool.map(work, jobs)
        except (BrokenProcessPool, OSError) as error:  # A pool raises OSError if it breaks while it gets its jobs.
            raise ConfigError(
                "a process that did the work was killed, as for want of memory; the same command begins again,"
                " with what is made"
            ) from error
        except (KeyboardInterrupt, GeneratorExit):
            # The processes are killed, because their jobs could take minutes.
            for process in set(active_children()).difference(others):
                process.kill()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def chosen_place(workers: int, cluster: str | None) -> JobPlace:
    """Return the place that ``--workers`` or ``--cluster`` chooses; raises :class:`ConfigError` if both are given."""
    if cluster is not None:
        if workers != 1:
            raise ConfigError("--workers cannot be used with --cluster, whose scheduler has the workers")
        # The import is here, because work on this computer needs no cluster.
        from q2r2_control.process.cluster import Cluster

        return Cluster(cluster)
    return HERE if workers == 1 else Processes(workers)
