"""Writes episodes as a LeRobotDataset, by the package lerobot: a dataset for each episode, and one of all of them.

https://github.com/huggingface/lerobot, ``lerobot.datasets``.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import EpisodeVectors

SOURCES = "meta/recordings.json"  # which recording an episode is of; lerobot itself does not read it
_NAME = "q2r2/recordings"  # datasets have one on the hub, where these are never sent
# The package asks no hub, and what it and the encoder of videos print are no results of a command.
_ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "TQDM_DISABLE": "1", "SVT_LOG": "1"}
_CAP_SYS_NICE, _CAPABILITY_VERSION = 23, 0x20080522  # linux/capability.h


def require_lerobot() -> None:
    """Raises :class:`ConfigError` where lerobot is not installed; it is not imported, which takes seconds."""
    if find_spec("lerobot") is None:
        raise ConfigError("export lerobot needs lerobot: pip install 'q2r2_control[lerobot]'")


def video_key(camera: str) -> str:
    """The feature of a camera's pictures."""
    return f"observation.images.{camera}"


def write_shard(episode: EpisodeVectors, folder: Path) -> None:
    """Write a dataset of one episode into a new ``folder``; what is there is removed."""
    shutil.rmtree(folder, ignore_errors=True)
    os.environ.update(_ENVIRONMENT)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    _renounce_real_time()
    features = _features(episode)
    dataset = LeRobotDataset.create(
        _NAME, episode.fps, features, root=folder, robot_type=episode.cell, use_videos=bool(episode.cameras)
    )
    outcome = {name: flags[:, None] for name, flags in episode.outcome().items()}
    pictures = {video_key(camera): iter(shown) for camera, shown in episode.cameras.items()}
    for frame in range(episode.frames):
        values: dict[str, Any] = {name: rows[frame] for name, rows in (episode.vectors | outcome).items()}
        values |= {name: next(shown) for name, shown in pictures.items()}
        dataset.add_frame({**values, "task": episode.task})
    dataset.save_episode(parallel_encoding=False)  # there are processes enough
    dataset.finalize()
    part = {"part": episode.part} if episode.part else {}
    source = {"episode_index": 0, "recording": episode.recording, **part, "success": episode.success, **episode.notes}
    _write_json(folder / SOURCES, [source])


def join_shards(shards: Sequence[Path], folder: Path) -> None:
    """Write the datasets of :func:`write_shard`, at least one, as one dataset into a new ``folder``.

    Raises :class:`RecordingError` where they do not have the same features, or are of different cells.
    """
    sources = [source for shard in shards for source in json.loads((shard / SOURCES).read_text())]
    _check_alike([json.loads((shard / "meta/info.json").read_text()) for shard in shards], sources)
    os.environ.update(_ENVIRONMENT)
    from lerobot.datasets.aggregate import aggregate_datasets

    with _cache_in(folder.with_name("cache")):
        aggregate_datasets([_NAME] * len(shards), _NAME, roots=list(shards), aggr_root=folder)
    _write_json(folder / SOURCES, [source | {"episode_index": number} for number, source in enumerate(sources)])


def _features(episode: EpisodeVectors) -> dict[str, dict[str, Any]]:
    """As lerobot asks for them; it has its own numbers of frames and episodes."""
    vectors = {
        name: {"dtype": "float32", "shape": (len(labels),), "names": list(labels)}
        for name, labels in episode.names.items()
    }
    outcome = {name: {"dtype": "bool", "shape": (1,), "names": None} for name in episode.outcome()}
    videos = {
        video_key(camera): {"dtype": "video", "shape": shown.size, "names": ["height", "width", "channels"]}
        for camera, shown in episode.cameras.items()
    }
    return {**vectors, **outcome, **videos}


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


@contextmanager
def _cache_in(folder: Path) -> Iterator[None]:
    """Let the package datasets keep its copies of tables in a folder that is removed, and not in the user's cache."""
    import datasets

    before = datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = folder
    try:
        yield
    finally:
        datasets.config.HF_DATASETS_CACHE = before
        shutil.rmtree(folder, ignore_errors=True)


def _renounce_real_time() -> None:
    """Let no thread that this one starts have real-time priority, also where this is root.

    The encoder of AV1 runs its threads under SCHED_FIFO where it may, and a control loop on the same machine would have
    to wait for a video.
    """
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


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=4, ensure_ascii=False), encoding="utf-8")
