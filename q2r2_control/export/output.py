"""An output is there whole or not at all: it grows beside its place, and is renamed into it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from q2r2_control.errors import ConfigError


class Output:
    """A file or folder that a command makes.

    What an export that was interrupted had made so far stays in ``OUT.partial``, and the next one goes on with it.
    Raises :class:`ConfigError` for an output that exists and one that cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._partial = path.with_name(f"{path.name}.partial")
        self._refuse_existing()

    def episodes(self) -> Path:
        """The folder in which episodes are kept until the output is whole."""
        folder = self._partial / "episodes"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--output {self._path}: {error.strerror}: {error.filename}") from error
        return folder

    def tidy(self) -> None:
        """Remove what is kept for the next export, if that is nothing."""
        with suppress(OSError):
            (self._partial / "episodes").rmdir()
            self._partial.rmdir()

    def write(self, write: Callable[[Path], None]) -> None:
        """Let ``write`` make the file or folder, and put it into its place."""
        made = self._partial / "output"
        try:
            _remove(made)
            write(made)
            self._refuse_existing()
            made.rename(self._path)
            shutil.rmtree(self._partial)
        except OSError as error:
            raise ConfigError(f"--output {self._path}: {error.strerror or error}") from error

    def _refuse_existing(self) -> None:
        if not self._path.name:
            raise ConfigError(f"--output {self._path}: allowed: a name that does not exist yet")
        if self._path.exists() or self._path.is_symlink():
            raise ConfigError(f"--output {self._path}: exists; allowed: a name that does not exist yet")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
