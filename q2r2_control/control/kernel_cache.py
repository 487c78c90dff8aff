"""Keep the machine code of kernels between runs.

Numba's own cache looks only at the path and the time of the compiled function's file. If a kernel of another module is
edited, its callers would therefore still run the old code. A second checkout would compile everything again. The name
of the cache folder is therefore a hash of all source files from which machine code is made. In this folder, the machine
code of a kernel is found by its module's name and its file's content.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator

_SUBPACKAGES = ("control", "compliance")
_COMPILED = re.compile(r"^@(inlined_|numpy_)?kernel|\bNamedTuple\b|^(from|import) numba\b", re.MULTILINE)
_VERSION = re.compile("[0-9a-f]{16}")


def compiled_sources() -> list[Path]:
    """Return the files that define kernels, their argument types, or how they are compiled.

    The machine code depends on no other file of this package.
    """
    package = Path(__file__).parents[1]
    sources = sorted(source for name in _SUBPACKAGES for source in (package / name).rglob("*.py"))
    return [source for source in sources if _COMPILED.search(source.read_text(encoding="utf-8"))]


def _cache_folder() -> Path:
    """Return the folder for the machine code of this version.

    Its time of modification becomes the newest, and all folders except the two newest are deleted.

    The folder of another running process may be deleted too. That process has its machine code in memory, and the code
    that it still compiles is written to a new folder. If the cache cannot be written, its content is still used.
    """
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in compiled_sources())).hexdigest()[:16]
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "q2r2_control"
        folder = root / digest
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            if any(folder.rglob("*.nbi")):
                return folder  # The machine code was compiled before, and is only read.
            raise
        os.utime(folder)
        _delete_old_versions(root)
        return folder
    except (OSError, RuntimeError) as error:
        # Numba runs the files of the cache as code. The cache is therefore never in a folder that another user could
        # have made. The kernels of this process go to a new folder.
        warnings.warn(
            f"compiled kernels cannot be kept: {error}. Every start compiles them anew; set XDG_CACHE_HOME to a folder "
            "that can be written",
            RuntimeWarning,
            stacklevel=2,
        )
        return Path(tempfile.mkdtemp(prefix="q2r2_control-")) / digest


def _delete_old_versions(root: Path) -> None:
    """Delete all but the two versions that were used last."""
    used = []
    for folder in root.iterdir():
        try:
            if _VERSION.fullmatch(folder.name) and not folder.is_symlink():
                used.append((folder.stat().st_mtime_ns, folder))
        except FileNotFoundError:
            continue  # Another process has deleted the folder.
    for _, folder in sorted(used)[:-2]:
        shutil.rmtree(folder, ignore_errors=True)


_FOLDER = str(_cache_folder())


class _ContentLocator(_CacheLocator):
    """Finds a function's machine code by the name of its module and the content of its file, in any folder."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file  # The cache names this file in a warning.
        self._folder = str(Path(_FOLDER) / re.sub(r"\W", "_", function.__module__))
        self._line = function.__code__.co_firstlineno
        self._stamp = hashlib.sha256(Path(file).read_bytes()).hexdigest()

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _ContentLocator:
        return cls(py_func, py_file)


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes = (_ContentLocator,)


class KernelCache(FunctionCache):
    """Numba's cache, in which :class:`_ContentLocator` finds the files.

    If the cache folder cannot be written, the cache is only read.
    """

    _impl_class = _KernelCacheImpl

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(OSError):  # If the code cannot be saved, the kernel still works, and the next start compiles it.
            super().save_overload(sig, data)
