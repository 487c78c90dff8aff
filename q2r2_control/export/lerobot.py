"""Writes episodes as a LeRobotDataset v3.0: a folder of parquet and JSON files.

The format is that of the package lerobot 0.4 (https://github.com/huggingface/lerobot, src/lerobot/datasets).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy.typing as npt

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import Episode
from q2r2_control.export.statistics import Statistics, joined, statistics_of

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
FILE_SIZE = 100  # of data [MB]; an episode that would not fit begins a new file
VIDEO_FILE_SIZE = 200  # [MB]; there are no videos yet: recordings have no pictures
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{_PLACE}.parquet"
EPISODES = f"meta/episodes/{_PLACE}.parquet"
TASKS, INFO, STATISTICS, SOURCES = "meta/tasks.parquet", "meta/info.json", "meta/stats.json", "meta/recordings.json"
_SCALARS = {
    "next.done": "bool",
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def require_pyarrow() -> Any:
    """The module pyarrow, with parquet. Raises :class:`ConfigError` where it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ConfigError("export lerobot needs pyarrow: pip install 'q2r2_control[export]'") from error
    return pyarrow


def write_dataset(files: Sequence[Path], folder: Path) -> None:
    """Write kept episodes, at least one, as a dataset into a ``folder`` that is made.

    Raises :class:`RecordingError` where they do not have the same features, or are of different cells.
    """
    writer = _Writer(Episode.load(files[0]), folder)
    for file in files:
        writer.add(Episode.load(file))
    writer.close()


class _Writer:
    """One dataset, episode by episode."""

    def __init__(self, first: Episode, folder: Path) -> None:
        self._arrow = require_pyarrow()
        self._first, self._folder = first, folder
        self._features = _features(first)
        self._schema = self._arrow.schema(
            [(name, self._kind(feature)) for name, feature in self._features.items()],
            metadata={"huggingface": json.dumps({"info": {"features": _loader_features(self._features)}})},
        )
        self._tasks: dict[str, int] = {}
        self._frames = 0
        self._rows: list[dict[str, Any]] = []  # of the table of episodes
        self._statistics: list[dict[str, Statistics]] = []
        self._sources: list[dict[str, Any]] = []
        self._data: Any = None  # the file that is being written
        self._files, self._size = 0, 0  # begun, and what is in the last one [bytes]

    def add(self, episode: Episode) -> None:
        """Write one more episode."""
        self._check(episode)
        number = len(self._rows)
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        columns = episode.columns(number, self._frames, task)
        self._write(columns)
        statistics = {name: statistics_of(columns[name]) for name in self._features}
        place = {"chunk_index": (self._files - 1) // FILES_PER_CHUNK, "file_index": (self._files - 1) % FILES_PER_CHUNK}
        self._rows.append(
            {
                "episode_index": number,
                "tasks": [episode.task],
                "length": episode.frames,
                **{f"data/{name}": value for name, value in place.items()},
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + episode.frames,
                **{
                    f"stats/{feature}/{name}": values.tolist()
                    for feature, found in statistics.items()
                    for name, values in found.items()
                },
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._statistics.append(statistics)
        self._sources.append({"episode_index": number, "recording": episode.recording, **episode.notes})
        self._frames += episode.frames

    def close(self) -> None:
        """Write what is said of all episodes."""
        self._data.close()
        self._write_table(EPISODES.format(chunk_index=0, file_index=0), self._arrow.Table.from_pylist(self._rows))
        self._write_table(TASKS, self._task_table())
        together = {name: joined([part[name] for part in self._statistics]) for name in self._features}
        self._write_json(
            STATISTICS,
            {feature: {name: values.tolist() for name, values in found.items()} for feature, found in together.items()},
        )
        self._write_json(INFO, self._info())
        self._write_json(SOURCES, self._sources)

    def _check(self, episode: Episode) -> None:
        first = self._first
        if episode.cell != first.cell:
            raise RecordingError(f"{episode.recording}: of cell {episode.cell}, but {first.recording} of {first.cell}")
        for feature, names in first.names.items():
            if episode.names.get(feature) != names:
                raise RecordingError(f"{episode.recording}: {feature} has not the numbers that {first.recording} has")

    def _write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        arrow = self._arrow
        arrays = []
        for name in self._features:
            column, kind = columns[name], self._schema.field(name).type
            if column.ndim == 2:
                arrays.append(arrow.FixedSizeListArray.from_arrays(arrow.array(column.ravel()), type=kind))
            else:
                arrays.append(arrow.array(column, type=kind))
        table = arrow.Table.from_arrays(arrays, schema=self._schema)
        if self._data is None or self._size + table.nbytes > FILE_SIZE << 20:
            if self._data is not None:
                self._data.close()
            place = DATA.format(chunk_index=self._files // FILES_PER_CHUNK, file_index=self._files % FILES_PER_CHUNK)
            self._data = arrow.parquet.ParquetWriter(self._made(place), self._schema, compression="snappy")
            self._files, self._size = self._files + 1, 0
        self._data.write_table(table)
        self._size += table.nbytes

    def _kind(self, feature: Mapping[str, Any]) -> Any:
        item = self._arrow.type_for_alias(feature["dtype"])
        return item if feature["names"] is None else self._arrow.list_(item, feature["shape"][0])

    def _task_table(self) -> Any:
        """As pandas writes a table whose index is the tasks, since readers look tasks up in that."""
        index = "__index_level_0__"
        kinds = (("task_index", "task_index", "int64", "int64"), (None, index, "unicode", "object"))
        columns = [
            {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
            for name, field, kind, numpy in kinds
        ]
        about = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
        table = self._arrow.table({"task_index": list(self._tasks.values()), index: list(self._tasks)})
        return table.replace_schema_metadata({"pandas": json.dumps(about)})

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self._first.cell,
            "total_episodes": len(self._rows),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": FILE_SIZE,
            "video_files_size_in_mb": VIDEO_FILE_SIZE,
            "fps": self._first.fps,
            "splits": {"train": f"0:{len(self._rows)}"},
            "data_path": DATA,
            "video_path": None,
            "features": self._features,
        }

    def _write_table(self, name: str, table: Any) -> None:
        self._arrow.parquet.write_table(table, self._made(name), compression="snappy")

    def _write_json(self, name: str, data: Any) -> None:
        self._made(name).write_text(json.dumps(data, indent=4, ensure_ascii=False), encoding="utf-8")

    def _made(self, name: str) -> Path:
        """A file of the dataset, with its folder made."""
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _features(episode: Episode) -> dict[str, dict[str, Any]]:
    """As ``info.json`` describes them."""
    vectors = {
        name: {"dtype": "float32", "shape": [len(labels)], "names": list(labels)}
        for name, labels in episode.names.items()
    }
    return {**vectors, **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _SCALARS.items()}}


def _loader_features(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The same for Hugging Face's datasets, which keep them in the metadata of a file."""
    described: dict[str, Any] = {}
    for name, feature in features.items():
        number = {"dtype": feature["dtype"], "_type": "Value"}
        vector = {"feature": number, "length": feature["shape"][0], "_type": "List"}
        described[name] = number if feature["names"] is None else vector
    return described
