"""Writes a LeRobotDataset with the package https://github.com/huggingface/lerobot, in the format of that package.

Each episode first becomes a dataset of its own. Then these datasets are joined.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.dataset_card import POSITION, SOURCES, write_card
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.lerobot_subtasks import add_subtasks, read_subtasks, write_subtasks
from q2r2_control.extras import install_line
from q2r2_control.inputs.policy import ActionSpace

# The package lerobot needs the name of a dataset on the Hugging Face hub. The datasets are never sent there.
_NAME = "q2r2/recordings"
# With these variables, the package makes no requests to the hub. Neither the package nor the video encoder prints its
# progress.
_ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "TQDM_DISABLE": "1", "SVT_LOG": "1"}
_CAP_SYS_NICE, _CAPABILITY_VERSION = 23, 0x20080522  # From linux/capability.h.


def require_lerobot() -> None:
    """Raise :class:`ConfigError` if lerobot is not installed. It is not imported, since that takes seconds."""
    if find_spec("lerobot") is None:
        raise ConfigError(f"export lerobot needs lerobot: {install_line('lerobot')}")


def video_key(camera: str) -> str:
    return f"observation.images.{camera}"


def source_of(episode: EpisodeVectors) -> dict[str, Any]:
    """Return the entry of an episode in :data:`SOURCES`, without its number."""
    part = {"part": episode.part} if episode.part else {}
    ahead = {"action_ahead_frames": episode.ahead} if episode.ahead else {}
    return {"recording": episode.recording, **part, "success": episode.success, **ahead, **episode.notes}


def write_sources(sources: Sequence[dict[str, Any]], folder: Path) -> None:
    numbered = [{"episode_index": number} | source for number, source in enumerate(sources)]
    (folder / SOURCES).write_text(json.dumps(numbered, indent=4, ensure_ascii=False), encoding="utf-8")


def write_shard(episode: EpisodeVectors, folder: Path) -> None:
    """Write a dataset of one episode into ``folder``. A folder of an earlier attempt is removed first."""
    shutil.rmtree(folder, ignore_errors=True)
    os.environ.update(_ENVIRONMENT)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    _renounce_real_time()
    features: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": (len(labels),), "names": _as_lerobot(name, labels)}
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
    # Parallel encoding is not needed, because the export already uses several processes.
    dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    (folder / SOURCES).write_text(json.dumps([source_of(episode)]), encoding="utf-8")
    write_subtasks(episode, folder)


def _as_lerobot(feature: str, labels: Sequence[str]) -> list[str]:
    ends = POSITION if feature in ("observation.state", ActionSpace.JOINTS) else ""
    return [f"{label}{ends}" for label in labels]


def join_shards(shards: Sequence[Path], folder: Path) -> None:
    """Join one or more datasets in a new ``folder``. Raises :class:`RecordingError` if their features differ."""
    sources = [source for shard in shards for source in json.loads((shard / SOURCES).read_text())]
    infos = [json.loads((shard / "meta/info.json").read_text()) for shard in shards]
    check_alike(infos, sources)
    os.environ.update(_ENVIRONMENT)
    import datasets
    from lerobot.datasets.aggregate import aggregate_datasets

    # The package ``datasets`` caches copies of the data. They must not stay in the user's cache.
    cache, datasets.config.HF_DATASETS_CACHE = datasets.config.HF_DATASETS_CACHE, folder.with_name("cache")
    try:
        aggregate_datasets([_NAME] * len(shards), _NAME, roots=list(shards), aggr_root=folder)
    finally:
        shutil.rmtree(datasets.config.HF_DATASETS_CACHE, ignore_errors=True)
        datasets.config.HF_DATASETS_CACHE = cache
    add_subtasks(read_subtasks(shards), folder)
    write_sources(sources, folder)
    write_card(infos[0], sources, folder)


def check_alike(infos: Sequence[dict[str, Any]], sources: Sequence[dict[str, Any]]) -> None:
    """Raise :class:`RecordingError` if episodes differ in their cells or features.

    Args:
        infos: For each episode, the content of its ``info.json``.
        sources: For each episode, its entry in :data:`SOURCES`.
    """
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
    """Prevent threads of the AV1 encoder from getting the priority SCHED_FIFO, even if root runs them.

    With SCHED_FIFO, the encoder could delay a control loop on the same computer.
    """
    if sys.platform != "linux":
        return
    import resource

    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    libc = ctypes.CDLL(None)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION, 0)
    # The effective, permitted and inheritable sets for the capabilities 0 to 31, and then the same sets for the others.
    sets = (ctypes.c_uint32 * 6)()
    if libc.capget(header, sets) == 0:
        sets[0] &= ~(1 << _CAP_SYS_NICE)
        sets[1] &= ~(1 << _CAP_SYS_NICE)
        libc.capset(header, sets)
