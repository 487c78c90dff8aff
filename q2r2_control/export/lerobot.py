"""Writes episodes as a LeRobotDataset v3.0: a folder of parquet and JSON files.

The format is that of the package lerobot 0.4 (https://github.com/huggingface/lerobot, src/lerobot/datasets).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.kept_pictures import KeptAs, place_of
from q2r2_control.export.statistics import Statistics, joined, statistics_of
from q2r2_control.export.video import CODEC, PIXEL_FORMAT, VideoFiles
from q2r2_control.export.video import FILE_SIZE as VIDEO_FILE_SIZE

VERSION = "v3.0"
FILES_PER_CHUNK = 1000
FILE_SIZE = 100  # of data [MB]; an episode that would not fit begins a new file
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{_PLACE}.parquet"
VIDEOS = f"videos/{{video_key}}/{_PLACE}.mp4"
EPISODES = f"meta/episodes/{_PLACE}.parquet"
TASKS, INFO, STATISTICS, SOURCES = "meta/tasks.parquet", "meta/info.json", "meta/stats.json", "meta/recordings.json"
_SCALARS = {
    "next.done": "bool",
    "next.success": "bool",
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
    writer = _Writer(EpisodeVectors.load(files[0]), folder)
    for file in files:
        writer.add(EpisodeVectors.load(file), file)
    writer.close()


class _Writer:
    """One dataset, episode by episode."""

    def __init__(self, first: EpisodeVectors, folder: Path) -> None:
        self._arrow = require_pyarrow()
        self._first, self._folder = first, folder
        columns, videos = _column_features(first), _video_features(first)
        self._features = {**columns, **videos}
        self._columns = tuple(columns)
        self._schema = self._arrow.schema(
            [(name, self._kind(feature)) for name, feature in columns.items()],
            metadata={"huggingface": json.dumps({"info": {"features": _loader_features(columns)}})},
        )
        self._videos = {camera: VideoFiles() for camera in first.cameras}
        self._tasks: dict[str, int] = {}
        self._frames = 0
        self._rows: list[dict[str, Any]] = []  # of the table of episodes
        self._statistics: list[dict[str, Statistics]] = []
        self._sources: list[dict[str, Any]] = []
        self._data: Any = None  # the file that is being written
        self._files, self._size = 0, 0  # begun, and what is in the last one [bytes]

    def add(self, episode: EpisodeVectors, file: Path) -> None:
        """Write one more episode, which is kept in ``file``."""
        self._check(episode)
        number = len(self._rows)
        task = self._tasks.setdefault(episode.task, len(self._tasks))
        columns = episode.columns(number, self._frames, task)
        self._write(columns)
        videos: dict[str, Any] = {}
        for camera in episode.cameras:
            videos |= self._add_video(camera, file, episode)
        statistics = {name: statistics_of(columns[name]) for name in self._columns}
        for camera, kept in episode.cameras.items():
            statistics[video_key(camera)] = {name: np.array(values) for name, values in kept.statistics.items()}
        self._rows.append(
            {
                "episode_index": number,
                "tasks": [episode.task],
                "length": episode.frames,
                **{f"data/{name}": value for name, value in _place(self._files - 1).items()},
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + episode.frames,
                **videos,
                **{
                    f"stats/{feature}/{name}": self._shaped(feature, name, values)
                    for feature, found in statistics.items()
                    for name, values in found.items()
                },
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._statistics.append(statistics)
        part = {"part": episode.part} if episode.part else {}
        source = {"episode_index": number, "recording": episode.recording, **part, "success": episode.success}
        self._sources.append({**source, **episode.notes})
        self._frames += episode.frames

    def close(self) -> None:
        """Write what is said of all episodes."""
        self._data.close()
        for video in self._videos.values():
            video.close()
        self._write_table(EPISODES.format(chunk_index=0, file_index=0), self._arrow.Table.from_pylist(self._rows))
        self._write_table(TASKS, self._task_table())
        together = {name: joined([part[name] for part in self._statistics]) for name in self._features}
        self._write_json(
            STATISTICS,
            {
                feature: {name: self._shaped(feature, name, values) for name, values in found.items()}
                for feature, found in together.items()
            },
        )
        self._write_json(INFO, self._info())
        self._write_json(SOURCES, self._sources)

    def _check(self, episode: EpisodeVectors) -> None:
        first = self._first
        if episode.cell != first.cell:
            raise RecordingError(f"{episode.recording}: of cell {episode.cell}, but {first.recording} of {first.cell}")
        for feature, names in first.names.items():
            if episode.names.get(feature) != names:
                raise RecordingError(f"{episode.recording}: {feature} has not the numbers that {first.recording} has")
        sizes = [[(name, kept.width, kept.height) for name, kept in made.cameras.items()] for made in (episode, first)]
        if sizes[0] != sizes[1]:
            raise RecordingError(
                f"{episode.recording}: has not the cameras that {first.recording} has; --no-pictures leaves them out"
            )

    def _add_video(self, camera: str, file: Path, episode: EpisodeVectors) -> dict[str, Any]:
        """Append an episode's video of a camera; returns where it is, as the table of episodes says it."""
        key, videos, source = video_key(camera), self._videos[camera], place_of(file, camera, KeptAs.VIDEO)
        if not videos.fits(source):
            videos.begin(self._made(VIDEOS.format(video_key=key, **_place(videos.number + 1))))
        begin = videos.add(source, episode.frames)
        return {
            **{f"videos/{key}/{name}": value for name, value in _place(videos.number).items()},
            f"videos/{key}/from_timestamp": begin / episode.fps,
            f"videos/{key}/to_timestamp": (begin + episode.frames) / episode.fps,
        }

    def _shaped(self, feature: str, name: str, values: npt.NDArray[Any]) -> Any:
        """A statistic as lists; colours have the shape of a picture, channel, row, column."""
        is_colour = self._features[feature]["dtype"] == "video" and name != "count"
        return (values.reshape(-1, 1, 1) if is_colour else values).tolist()

    def _write(self, columns: Mapping[str, npt.NDArray[Any]]) -> None:
        arrow = self._arrow
        arrays = []
        for name in self._columns:
            column, kind = columns[name], self._schema.field(name).type
            if column.ndim == 2:
                arrays.append(arrow.FixedSizeListArray.from_arrays(arrow.array(column.ravel()), type=kind))
            else:
                arrays.append(arrow.array(column, type=kind))
        table = arrow.Table.from_arrays(arrays, schema=self._schema)
        if self._data is None or self._size + table.nbytes > FILE_SIZE << 20:
            if self._data is not None:
                self._data.close()
            place = DATA.format(**_place(self._files))
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
            "video_path": VIDEOS if self._videos else None,
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


def video_key(camera: str) -> str:
    """The feature of a camera's pictures."""
    return f"observation.images.{camera}"


def _place(number: int) -> dict[str, int]:
    """Of a file, counted from 0."""
    return {"chunk_index": number // FILES_PER_CHUNK, "file_index": number % FILES_PER_CHUNK}


def _column_features(episode: EpisodeVectors) -> dict[str, dict[str, Any]]:
    """As ``info.json`` describes those of the table of frames."""
    vectors = {
        name: {"dtype": "float32", "shape": [len(labels)], "names": list(labels)}
        for name, labels in episode.names.items()
    }
    return {**vectors, **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _SCALARS.items()}}


def _video_features(episode: EpisodeVectors) -> dict[str, dict[str, Any]]:
    """As ``info.json`` describes videos."""
    return {
        video_key(camera): {
            "dtype": "video",
            "shape": [kept.height, kept.width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": kept.height,
                "video.width": kept.width,
                "video.codec": CODEC,
                "video.pix_fmt": PIXEL_FORMAT,
                "video.is_depth_map": False,
                "video.fps": episode.fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
        for camera, kept in episode.cameras.items()
    }


def _loader_features(features: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The same for Hugging Face's datasets, which keep them in the metadata of a file."""
    described: dict[str, Any] = {}
    for name, feature in features.items():
        number = {"dtype": feature["dtype"], "_type": "Value"}
        vector = {"feature": number, "length": feature["shape"][0], "_type": "List"}
        described[name] = number if feature["names"] is None else vector
    return described
