"""Folders for what runs leave behind, none of which overwrites another."""

from __future__ import annotations

from pathlib import Path

from q2r2_control.errors import ConfigError


def new_folder(parent: Path, name: str, what: str) -> Path:
    """A folder that did not exist before: ``name``, or numbered where several runs begin within one second.

    Raises :class:`ConfigError` that begins with ``what``.
    """
    for suffix in ("", *(f"-{number}" for number in range(2, 100))):
        folder = parent / (name + suffix)
        try:
            folder.mkdir(parents=True)
        except FileExistsError as error:
            if not folder.exists():  # a parent is a file
                raise ConfigError(f"{what} {folder}: {error.strerror}") from error
            continue
        except OSError as error:
            raise ConfigError(f"{what} {folder}: {error.strerror}") from error
        return folder
    raise ConfigError(f"{what} {parent / name}: exists, and so do 98 numbered ones")
