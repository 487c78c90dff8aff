"""Writes episodes as tables of text: a file each, a line a frame."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from q2r2_control.errors import RecordingError
from q2r2_control.export.episodes import EpisodeVectors

_TEXTS = ("recording", "cell", "task", "fps", "names", "notes", "success", "part")


def write_vectors(episode: EpisodeVectors, path: Path) -> None:
    """Keep an episode as arrays until all are known, by which frames and tasks are numbered."""
    about = json.dumps({name: getattr(episode, name) for name in _TEXTS})
    with path.open("wb") as stream:
        np.savez(stream, about=np.array(about), **episode.vectors)  # type: ignore[arg-type]


def load_vectors(path: Path) -> EpisodeVectors:
    """An episode that was kept."""
    with np.load(path) as kept:
        about = json.loads(str(kept["about"]))
        vectors = {name: kept[name] for name in about["names"]}
    about["names"] = {name: tuple(labels) for name, labels in about["names"].items()}
    return EpisodeVectors(**about, vectors=vectors)


def write_tables(files: Sequence[Path], folder: Path) -> None:
    """Write each kept episode into a ``folder`` that is made, named as its recording.

    Raises :class:`RecordingError` where two recordings have one name.
    """
    folder.mkdir()
    first_frame = 0
    tasks: dict[str, int] = {}
    for index, file in enumerate(files):
        episode = load_vectors(file)
        path = folder / f"{episode.name}.csv"
        if path.exists():
            raise RecordingError(f"{episode.recording}: two recordings have this name; allowed: each one once")
        _write(episode, path, _Place(index, first_frame, tasks.setdefault(episode.task, len(tasks))))
        first_frame += episode.frames


def write_table(files: Sequence[Path], path: Path) -> None:
    """Write the one kept episode to a file. Raises :class:`RecordingError` where there are several."""
    first = load_vectors(files[0])
    if len(files) > 1:
        raise RecordingError(f"{first.recording}: has {len(files)} episodes; allowed: a folder as --output, or one")
    _write(first, path, _Place(0, 0, 0))


@dataclass(frozen=True)
class _Place:
    """Of an episode in its dataset."""

    index: int
    first_frame: int
    task: int


def _write(episode: EpisodeVectors, path: Path, place: _Place) -> None:
    frames = np.arange(episode.frames)
    columns = {
        **{
            f"{name}.{label}": episode.vectors[name][:, at]
            for name, labels in episode.names.items()
            for at, label in enumerate(labels)
        },
        **episode.outcome(),
        "timestamp": (frames / episode.fps).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full(episode.frames, place.index),
        "index": place.first_frame + frames,
        "task_index": np.full(episode.frames, place.task),
    }
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*columns, "task"])
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        writer.writerows([*row, episode.task] for row in rows)
