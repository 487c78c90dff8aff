"""Writes episodes as tables of text: a file each, a line a frame."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from q2r2_control.errors import RecordingError
from q2r2_control.export.episodes import EpisodeVectors


def write_tables(files: Sequence[Path], folder: Path) -> None:
    """Write each kept episode into a ``folder`` that is made, named as its recording.

    Raises :class:`RecordingError` where two recordings have one name.
    """
    folder.mkdir()
    first_frame = 0
    tasks: dict[str, int] = {}
    for index, file in enumerate(files):
        episode = EpisodeVectors.load(file)
        path = folder / f"{episode.name}.csv"
        if path.exists():
            raise RecordingError(f"{episode.recording}: two recordings have this name; allowed: each one once")
        _write(episode, path, index, first_frame, tasks.setdefault(episode.task, len(tasks)))
        first_frame += episode.frames


def write_table(files: Sequence[Path], path: Path) -> None:
    """Write the one kept episode to a file. Raises :class:`RecordingError` where there are several."""
    first = EpisodeVectors.load(files[0])
    if len(files) > 1:
        raise RecordingError(f"{first.recording}: has {len(files)} episodes; allowed: a folder as --output, or one")
    _write(first, path, 0, 0, 0)


def _write(episode: EpisodeVectors, path: Path, index: int, first_frame: int, task: int) -> None:
    columns = episode.columns(index, first_frame, task)
    head: list[str] = []
    values: list[list[object]] = []
    for name, column in columns.items():
        labels = episode.names.get(name)
        head += [name] if labels is None else [f"{name}.{label}" for label in labels]
        values += [column.tolist()] if labels is None else [part.tolist() for part in column.T]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*head, "task"])
        writer.writerows([*row, episode.task] for row in zip(*values, strict=True))
