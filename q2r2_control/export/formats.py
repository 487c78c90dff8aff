"""The formats of ``q2r2 export``: CSV, HDF5 and LeRobotDataset.

CSV and HDF5 have a file for each episode; HDF5 is laid out as ``record_sim_episodes.py`` in
https://github.com/tonyzhaozh/act does it. The package https://github.com/huggingface/lerobot writes a LeRobotDataset of
each episode, and joins them.
"""

from __future__ import annotations

import csv
import ctypes
import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import EpisodeVectors, Write

_AHEAD = 1  # frames by which actions in HDF5 are
# Name in the HDF5 file, name of the feature, unit of a joint.
_DATA = (
    ("observations/qpos", "observation.state", "rad"),
    ("observations/qvel", "observation.velocity", "rad/s"),
    ("action", "action", "rad"),
)
_OPENING, _OPENING_UNIT = "_gripper", "0 closed .. 1 open"
_COMPRESSION = 1  # of gzip's levels, the fastest

SOURCES = "meta/recordings.json"  # which recording an episode is of; lerobot itself does not read it
_NAME = "q2r2/recordings"  # datasets have one on the hub, where these are never sent
# The package asks no hub, and what it and the encoder of videos print are no results of a command.
_ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "TQDM_DISABLE": "1", "SVT_LOG": "1"}
_CAP_SYS_NICE, _CAPABILITY_VERSION = 23, 0x20080522  # linux/capability.h


def write_table(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode as CSV, a line a frame."""
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
    """Move tables into a new ``folder``, named as recordings. Raises :class:`RecordingError` for one name twice."""
    folder.mkdir()
    for file in files:
        path = folder / f"{file.stem}.csv"
        if path.exists():
            raise RecordingError(f"{file.stem}.mcap: two recordings have this name; allowed: each one once")
        file.replace(path)


def require_h5py() -> Any:
    """The module h5py. Raises :class:`ConfigError` where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise ConfigError("export hdf5 needs h5py: pip install 'q2r2_control[export]'") from error
    return h5py


def write_hdf5(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode as HDF5."""
    with require_h5py().File(path, "w") as file:
        file.attrs["sim"] = True  # trainers take the action of the same row then
        file.attrs["compress"] = False  # pictures are pixels, however the file packs them
        file.attrs["fps"] = episode.fps
        file.attrs["action_ahead_frames"] = _AHEAD
        for name in ("recording", "cell", "task"):
            file.attrs[name] = getattr(episode, name)
        if episode.success is not None:
            file.attrs["success"] = episode.success
        for name, text in episode.notes.items():
            file.attrs[f"note_{name}"] = text
        for name, feature, unit in _DATA:
            values, labels = episode.vectors[feature], episode.names[feature]
            if name == "action":
                values = np.concatenate((values[_AHEAD:], np.repeat(values[-1:], _AHEAD, axis=0)))[: episode.frames]
            data = file.create_dataset(name, data=values)
            data.attrs["names"] = list(labels)
            data.attrs["units"] = [_OPENING_UNIT if label.endswith(_OPENING) else unit for label in labels]
        images = file.create_group("observations/images")
        for camera, pictures in episode.cameras.items():
            # Each picture is packed by itself, so that one can be read without the others.
            packing = {"chunks": (1, *pictures.size), "compression": "gzip", "compression_opts": _COMPRESSION}
            data = images.create_dataset(camera, (episode.frames, *pictures.size), "uint8", **packing)
            data.attrs["axes"] = ["frame", "row", "column", "r g b"]
            for number, pixels in enumerate(pictures):
                data[number] = pixels


def gather_hdf5(files: Sequence[Path], folder: Path) -> None:
    """Move HDF5 files into a new ``folder``, as ``episode_0.hdf5`` and so on."""
    folder.mkdir()
    for number, file in enumerate(files):
        file.replace(folder / f"episode_{number}.hdf5")


def require_lerobot() -> None:
    """Raises :class:`ConfigError` where lerobot is not installed; it is not imported, which takes seconds."""
    if find_spec("lerobot") is None:
        raise ConfigError("export lerobot needs lerobot: pip install 'q2r2_control[lerobot]'")


def video_key(camera: str) -> str:
    return f"observation.images.{camera}"


def write_shard(episode: EpisodeVectors, folder: Path) -> None:
    """Write a dataset of one episode into a new ``folder``; what is there is removed."""
    shutil.rmtree(folder, ignore_errors=True)
    os.environ.update(_ENVIRONMENT)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    _renounce_real_time()
    features: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": (len(labels),), "names": list(labels)}
        for name, labels in episode.names.items()
    }
    outcome = {name: flags[:, None] for name, flags in episode.outcome().items()}
    features |= {name: {"dtype": "bool", "shape": (1,), "names": None} for name in outcome}
    pictures = {}
    for camera, shown in episode.cameras.items():
        features[video_key(camera)] = {"dtype": "video", "shape": shown.size, "names": ["height", "width", "channels"]}
        pictures[video_key(camera)] = iter(shown)
    dataset = LeRobotDataset.create(
        _NAME, episode.fps, features, root=folder, robot_type=episode.cell, use_videos=bool(episode.cameras)
    )
    for frame in range(episode.frames):
        values: dict[str, Any] = {name: rows[frame] for name, rows in (episode.vectors | outcome).items()}
        values |= {name: next(shown) for name, shown in pictures.items()}
        dataset.add_frame({**values, "task": episode.task})
    dataset.save_episode(parallel_encoding=False)  # there are processes enough
    dataset.finalize()
    part = {"part": episode.part} if episode.part else {}
    source = {"episode_index": 0, "recording": episode.recording, **part, "success": episode.success, **episode.notes}
    (folder / SOURCES).write_text(json.dumps([source]), encoding="utf-8")


def join_shards(shards: Sequence[Path], folder: Path) -> None:
    """Join datasets, at least one, in a new ``folder``. Raises :class:`RecordingError` where their features differ."""
    sources = [source for shard in shards for source in json.loads((shard / SOURCES).read_text())]
    _check_alike([json.loads((shard / "meta/info.json").read_text()) for shard in shards], sources)
    os.environ.update(_ENVIRONMENT)
    import datasets
    from lerobot.datasets.aggregate import aggregate_datasets

    # The package datasets keeps copies of tables, which are not for the user's cache.
    cache, datasets.config.HF_DATASETS_CACHE = datasets.config.HF_DATASETS_CACHE, folder.with_name("cache")
    try:
        aggregate_datasets([_NAME] * len(shards), _NAME, roots=list(shards), aggr_root=folder)
    finally:
        shutil.rmtree(datasets.config.HF_DATASETS_CACHE, ignore_errors=True)
        datasets.config.HF_DATASETS_CACHE = cache
    sources = [source | {"episode_index": number} for number, source in enumerate(sources)]
    (folder / SOURCES).write_text(json.dumps(sources, indent=4, ensure_ascii=False), encoding="utf-8")


def _check_alike(infos: Sequence[dict[str, Any]], sources: Sequence[dict[str, Any]]) -> None:
    first, first_recording = infos[0], sources[0]["recording"]
    for info, source in zip(infos, sources, strict=True):
        cell, recording = info["robot_type"], source["recording"]
        if cell != first["robot_type"]:
            raise RecordingError(f"{recording}: of cell {cell}, but {first_recording} of {first['robot_type']}")
        for name in sorted(first["features"].keys() | info["features"].keys()):
            feature, wanted = info["features"].get(name), first["features"].get(name)
            if feature == wanted:
                continue
            if "video" in ((feature or {}).get("dtype"), (wanted or {}).get("dtype")):
                raise RecordingError(
                    f"{recording}: has not the cameras that {first_recording} has; --no-pictures leaves them out"
                )
            raise RecordingError(f"{recording}: {name} has not the numbers that {first_recording} has")


def _renounce_real_time() -> None:
    """Keep threads of the AV1 encoder from SCHED_FIFO, also of root: a control loop must not wait for a video."""
    if sys.platform != "linux":
        return
    import resource

    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    libc = ctypes.CDLL(None)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted and inheritable, of capabilities 0 to 31 and of the others
    if libc.capget(header, sets) == 0:
        sets[0] &= ~(1 << _CAP_SYS_NICE)
        sets[1] &= ~(1 << _CAP_SYS_NICE)
        libc.capset(header, sets)


@dataclass(frozen=True)
class Format:
    """How episodes are written one by one, and then joined in the output."""

    write: Write
    join: Callable[[Sequence[Path], Path], None]
    require: Callable[[], object] = lambda: None  # raises ConfigError where a package is not installed


FORMATS = {
    "lerobot": Format(write_shard, join_shards, require_lerobot),
    "hdf5": Format(write_hdf5, gather_hdf5, require_h5py),
    "csv": Format(write_table, gather_tables),
}
