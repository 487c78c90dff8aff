"""Run jobs in a worker of a cluster. The worker first compares its code and files with those of the sender."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

from q2r2_control.errors import ConfigError

_SHARED = "allowed: a folder that all machines share, under the same path"


@dataclass(frozen=True)
class Needs:
    """What must be the same for a worker as for the computer that sends the jobs. All paths are absolute."""

    sources: str  # The result of :func:`hash_of_sources`.
    folder: str | None = None  # The working directory, from which relative paths begin; None if no files are read.
    files: tuple[tuple[str, int], ...] = ()  # Paths of recordings, with their sizes [bytes].
    probe: str | None = None  # A file that the sender made in the folder into which jobs write.


@dataclass(frozen=True)
class Call:
    """One job, the function that does it, and what it needs. A call returns the machine's name and the result."""

    work: Callable[[Any], Any]
    job: Any
    needs: Needs

    def __call__(self) -> tuple[str, Any]:
        # This worker may have joined after all others were compared. If it cannot see a file, the job must not run.
        if (fault := fault_of(self.needs)) is not None:
            raise ConfigError(f"worker on {platform.node()}: {fault}")
        if self.needs.folder is None:
            return platform.node(), self.work(self.job)
        with chdir(self.needs.folder):  # This disturbs no other job, because the worker has a single thread for jobs.
            return platform.node(), self.work(self.job)


@cache
def hash_of_sources() -> str:
    """Return a hash of this package's modules, as they were when this process first called this function."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(f"{file.relative_to(package)}\0".encode() + file.read_bytes())
    return digest.hexdigest()


def look(needs: Needs, work: Callable[[Any], Any]) -> str | None:
    """Return what this worker lacks, or None. If the worker cannot import ``work``, the call itself fails."""
    return fault_of(needs)


def fault_of(needs: Needs) -> str | None:
    """Return in words which of the ``needs`` this process does not have; None if it has all."""
    if needs.sources != hash_of_sources():
        return "another q2r2_control than here; allowed: the same code, and workers that began after its last change"
    if needs.folder is not None and not Path(needs.folder).is_dir():
        return f"cannot see {needs.folder}; {_SHARED}"
    for name, size in needs.files:
        try:
            found = Path(name).stat().st_size
        except OSError:
            return f"cannot see {_highest_missing(Path(name))}; {_SHARED}"
        if found != size:
            return f"another {name}: {found} bytes there, {size} here; {_SHARED}"
    return None if needs.probe is None else _write_fault(Path(needs.probe))


@lru_cache(maxsize=1)
def _write_fault(probe: Path) -> str | None:
    """Return why this process cannot write beside ``probe``, or None."""
    if not probe.exists():
        missing = _highest_missing(probe)
        fault = f"another {probe.parent} than here" if missing == probe else f"cannot see {missing}"
        return f"{fault}; {_SHARED}"
    try:
        with (own := probe.with_name(f"{probe.name}.{uuid4().hex}")).open("xb"):
            own.unlink()
    except OSError as error:
        return f"cannot write into {probe.parent}: {error.strerror}; allowed: a folder that all machines may write"
    return None


def _highest_missing(path: Path) -> Path:
    """Return the highest folder of ``path``, or ``path`` itself, that does not exist here; ``path`` if all exist."""
    return next((part for part in (*reversed(path.parents), path) if not part.exists()), path)
