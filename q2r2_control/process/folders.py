"""Make the folders of files, and check before long work that files can be written."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryFile

from q2r2_control.errors import ConfigError

_LEAST_ROOM = 1 << 16  # Free space that a folder must have [bytes].


def new_folder(parent: Path, name: str, what: str) -> Path:
    """Make a folder that did not exist before. Its ``name`` gets a number if several runs begin within one second.

    Raises:
        ConfigError: If the folder cannot be made. The message begins with ``what``.
    """
    for suffix in ("", *(f"-{number}" for number in range(2, 100))):
        folder = parent / (name + suffix)
        try:
            folder.mkdir(parents=True)
            return folder
        except OSError as error:
            # If the folder exists, the next number is tried. A broken link causes a FileExistsError too, but no number
            # helps against it.
            if not (isinstance(error, FileExistsError) and folder.exists()):
                raise ConfigError(f"{what} {folder}: {error.strerror}") from error
    raise ConfigError(f"{what} {parent / name}: exists, and so do 98 numbered ones")


def check_folder(folder: Path, what: str) -> None:
    """Make ``folder`` if it does not exist.

    Raises:
        ConfigError: If the folder cannot be made, or if nothing can be written in it. The message begins with ``what``.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _try_to_write(folder)
    except OSError as error:
        fault = "is a file" if isinstance(error, FileExistsError) else error.strerror or error
        raise ConfigError(f"{what} {folder}: {fault}; allowed: a folder that can be written") from error


def check_file(file: Path, what: str) -> None:
    """Check that ``file`` can be written, and leave everything as it is. Call this before long work for the file.

    Raises:
        ConfigError: If the file is a folder or cannot be written. The message begins with ``what``.
    """
    try:
        if file.exists():
            with file.open("ab"):
                pass
        else:
            _try_to_write(file.parent)
    except OSError as error:
        allowed = "allowed: a file in a folder that exists and can be written"
        raise ConfigError(f"{what} {file}: {error.strerror or error}; {allowed}") from error


def _try_to_write(folder: Path) -> None:
    """Write a file in ``folder``, and remove it; raises OSError if this is impossible."""
    with TemporaryFile(dir=folder) as file:
        file.write(bytes(_LEAST_ROOM))
        file.flush()
