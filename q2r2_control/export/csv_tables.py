"""Writes episodes as tables of text: a file each, a line a frame."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import RecordingError
from q2r2_control.export.episodes import EpisodeVectors


def write_table(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode."""
    frames = np.arange(episode.frames)
    columns: dict[str, npt.NDArray[Any]] = {
        f"{name}.{label}": episode.vectors[name][:, at]
        for name, labels in episode.names.items()
        for at, label in enumerate(labels)
    }
    columns |= episode.outcome()
    columns |= {"timestamp": (frames / episode.fps).astype(np.float32), "frame_index": frames}
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*columns, "task"])
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        writer.writerows([*row, episode.task] for row in rows)


def gather_tables(files: Sequence[Path], folder: Path) -> None:
    """Move kept episodes into a ``folder`` that is made, named as their recordings.

    Raises :class:`RecordingError` where two recordings have one name.
    """
    folder.mkdir()
    for file in files:
        path = folder / f"{file.stem}.csv"
        if path.exists():
            raise RecordingError(f"{file.stem}.mcap: two recordings have this name; allowed: each one once")
        file.replace(path)


def move_table(files: Sequence[Path], path: Path) -> None:
    """Move the one kept episode to its file. Raises :class:`RecordingError` where there are several."""
    if len(files) > 1:
        raise RecordingError(f"--output {path.name}: for {len(files)} episodes; allowed: a folder, or one episode")
    files[0].replace(path)
