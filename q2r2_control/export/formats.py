"""The formats of ``q2r2 export``: CSV, HDF5, two versions of LeRobotDataset, and formats that other packages declare.

CSV and HDF5 have a file for each episode. An HDF5 file has the layout of ``record_sim_episodes.py`` in
https://github.com/tonyzhaozh/act. One more HDF5 file links to the data of all episodes. It has the layout of
https://github.com/ARISE-Initiative/robomimic.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError, RecordingError, shown
from q2r2_control.export.episodes import SUBTASK, EpisodeVectors
from q2r2_control.export.export_format import ExportFormat
from q2r2_control.export.lerobot import join_shards, require_lerobot, write_shard
from q2r2_control.export.lerobot_v21 import join_v21, openpi_config, require_v21, write_v21
from q2r2_control.export.sampling import CameraFrames, units_of
from q2r2_control.extras import install_line
from q2r2_control.plugins import EXPORTS, load_class, names_of, package_to_install

# Pairs of names: of data in the HDF5 file, and of the feature from which the data comes.
_DATA = (
    ("observations/qpos", "observation.state"),
    ("observations/qvel", "observation.velocity"),
    ("action", "action"),
)
_AXES = ("frame", "row", "column")
_COMPRESSION = 1  # The fastest level of gzip.
ROBOMIMIC = "robomimic.h5"  # The name does not end with .hdf5, because some trainers of ACT read all such files.
UNITS = "units.json"  # The file beside the CSV files, with the unit of each column of numbers.
# For each name that robomimic reads in a demonstration: the name of the data to which it links.
_LINKS = {
    **{"actions": "action", "rewards": "rewards", "dones": "dones"},
    **{"obs/qpos": "observations/qpos", "obs/qvel": "observations/qvel"},
}


def write_table(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode as CSV, with one line for each frame."""
    frames = np.arange(episode.frames)
    columns: dict[str, npt.NDArray[Any]] = {
        f"{name}.{label}": episode.vectors[name][:, at]
        for name, labels in episode.names.items()
        for at, label in enumerate(labels)
    }
    columns |= episode.outcome()
    columns |= {"timestamp": frames / episode.fps, "frame_index": frames}
    columns["task"] = np.full(episode.frames, episode.task, dtype=object)
    if episode.subtasks:
        columns[SUBTASK] = np.array(episode.subtask)
        columns["subtask"] = np.array(episode.subtasks, dtype=object)[columns[SUBTASK]]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def gather_tables(files: Sequence[Path], folder: Path) -> None:
    """Move CSV files into a new ``folder``, and write the units of their columns into :data:`UNITS`.

    Each CSV file gets the name of its recording.

    Raises :class:`RecordingError` if two recordings have the same name.
    """
    folder.mkdir()
    units = {"timestamp": "s"}
    for file in files:
        with file.open(newline="", encoding="utf-8") as stream:
            columns = [column.rpartition(".") for column in next(csv.reader(stream))]
        numbers = [(feature, label) for feature, _, label in columns if feature not in ("", "next")]
        units |= {f"{feature}.{label}": units_of({feature: (label,)})[feature][0] for feature, label in numbers}
        path = folder / f"{file.stem}.csv"
        if path.exists():
            raise RecordingError(f"{file.stem}.mcap: two recordings have this name; allowed: each one once")
        file.replace(path)
    (folder / UNITS).write_text(json.dumps(units, indent=2) + "\n", encoding="utf-8")


def require_h5py() -> Any:
    """Return the module h5py. Raises :class:`ConfigError` if it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise ConfigError(f"export hdf5 needs h5py: {install_line('export')}") from error
    return h5py


def write_hdf5(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode as HDF5."""
    with require_h5py().File(path, "w") as file:
        file.attrs["sim"] = True  # With this value, trainers pair an observation with the action of the same row.
        file.attrs["compress"] = False  # Trainers read plain pixels, not JPEG; HDF5 itself compresses them.
        file.attrs["fps"] = episode.fps
        file.attrs["action_ahead_frames"] = episode.ahead
        for name in ("recording", "cell", "task"):
            file.attrs[name] = getattr(episode, name)
        if episode.success is not None:
            file.attrs["success"] = episode.success
        for name, text in episode.notes.items():
            file.attrs[f"note_{name}"] = text
        for name, feature in _DATA:
            data = file.create_dataset(name, data=episode.vectors[feature])
            data.attrs["names"] = list(episode.names[feature])
            data.attrs["units"] = list(episode.units[feature])
        for name, flags in zip(("dones", "rewards"), episode.outcome().values(), strict=True):
            file.create_dataset(name, data=flags.astype(np.float32))
        if episode.subtasks:
            file.create_dataset(SUBTASK, data=np.array(episode.subtask)).attrs["names"] = list(episode.subtasks)
        images = file.create_group("observations/images")
        for camera, pictures in episode.cameras.items():
            _write_pictures(images, camera, pictures, episode.frames).attrs["axes"] = [*_AXES, "r g b"]
        if episode.depths:
            depths = file.create_group("observations/depth")
            for camera, pictures in episode.depths.items():
                made = _write_pictures(depths, camera, pictures, episode.frames)
                made.attrs["axes"], made.attrs["unit"] = list(_AXES), pictures.unit


def _write_pictures(group: Any, camera: str, pictures: CameraFrames, frames: int) -> Any:
    """Write the pictures of a camera into a group of an HDF5 file, and return the HDF5 dataset."""
    # Each picture is compressed by itself, so that a reader can decode a single picture.
    packing = {"chunks": (1, *pictures.size), "compression": "gzip", "compression_opts": _COMPRESSION}
    data = group.create_dataset(camera, (frames, *pictures.size), pictures.dtype, **packing)
    for number, pixels in enumerate(pictures):
        data[number] = pixels
    return data


def gather_hdf5(files: Sequence[Path], folder: Path) -> None:
    """Move HDF5 files into a new ``folder``, and write the file :data:`ROBOMIMIC` with links to them.

    The files are renamed to ``episode_0.hdf5``, ``episode_1.hdf5`` and so on.
    """
    h5py, total = require_h5py(), 0
    folder.mkdir()
    with h5py.File(folder / ROBOMIMIC, "w") as joined:
        demos = joined.create_group("data")
        for number, file in enumerate(files):
            moved = file.replace(folder / f"episode_{number}.hdf5")
            demo = demos.create_group(f"demo_{number}")
            with h5py.File(moved) as episode:
                frames, cell = len(episode["action"]), episode.attrs["cell"]
                pictures = {
                    f"obs/{camera}": f"observations/images/{camera}" for camera in episode["observations/images"]
                }
            for name, target in (_LINKS | pictures).items():
                demo[name] = h5py.ExternalLink(moved.name, target)
            demo.attrs["num_samples"] = frames
            total += frames
        # robomimic needs the description of an environment, even if the training uses no environment. Type 2 stands for
        # Gym.
        demos.attrs["env_args"] = json.dumps({"env_name": cell, "type": 2, "env_kwargs": {}})
        demos.attrs["total"] = total


FORMATS = {
    "lerobot": ExportFormat(write_shard, join_shards, require_lerobot),
    "lerobot-v2.1": ExportFormat(write_v21, join_v21, require_v21, openpi_config),
    "hdf5": ExportFormat(write_hdf5, gather_hdf5, require_h5py, has_depth=True, ahead=1),
    "csv": ExportFormat(write_table, gather_tables),
}


def format_named(name: str) -> ExportFormat:
    """Return the format called ``name``, of this package or another package.

    Raises :class:`ConfigError` if no format has this name.
    """
    if (own := FORMATS.get(name)) is not None:
        return own
    others = names_of(EXPORTS)
    if name not in others:
        if (missing := package_to_install(EXPORTS, name)) is not None:
            raise ConfigError(f"export {name}: {missing}")
        raise ConfigError(f"export {name}: allowed: {', '.join((*FORMATS, *others))}")
    found = load_class(EXPORTS, name)
    if not isinstance(found, ExportFormat):
        raise ConfigError(f"export {name} is {shown(found)}; allowed: an ExportFormat")
    return found
