"""Which files are meant by the paths that a user gives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from q2r2_control.errors import RecordingError


def recordings_in(paths: Sequence[Path]) -> list[Path]:
    """Files of recordings: those given, and all in folders given, by name; each once.

    Raises :class:`RecordingError` for a path without any.
    """
    files: dict[Path, Path] = {}
    for path in paths:
        if path.is_dir():
            found = sorted(path.rglob("*.mcap"))
            if not found:
                raise RecordingError(f"{path}: no file .mcap in it; allowed: recordings of q2r2 run --record")
        elif path.exists():
            found = [path]
        else:
            raise RecordingError(f"{path}: no such file or folder")
        for file in found:
            files.setdefault(file.resolve(), file)
    return list(files.values())
