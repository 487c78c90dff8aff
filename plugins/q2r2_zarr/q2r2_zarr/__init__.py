"""The format ``zarr`` of ``q2r2 export``. Its output is one zarr store, which diffusion_policy's ReplayBuffer reads.

The arrays under ``data`` contain all episodes one after the other. For each episode, ``meta/episode_ends`` has the
index of the row after its last row. See
https://github.com/real-stanford/diffusion_policy, diffusion_policy/common/replay_buffer.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from q2r2_control import EpisodeVectors, ExportFormat, RecordingError

_ZARR_FORMAT = 2  # Version of zarr's format that diffusion_policy's version of the package reads.
_FRAMES_PER_CHUNK = 1000  # Number of frames in one chunk of numbers. Each picture is a chunk of its own.


def array_name(feature: str) -> str:
    """Return the name of a feature's array, such as ``state`` for ``observation.state``."""
    return feature.removeprefix("observation.").replace(".", "_")


def write_episode(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode as a store of its own at ``path``. A store that exists there is removed first."""

    root = zarr.open_group(str(path), mode="w", zarr_format=_ZARR_FORMAT)
    root.attrs.update(
        {
            **{name: getattr(episode, name) for name in ("cell", "task", "fps", "recording", "success")},
            "action_ahead_frames": episode.ahead,
            "notes": dict(episode.notes),
            "subtasks": list(episode.subtasks),
        }
    )
    data = root.create_group("data")
    for feature, rows in episode.vectors.items():
        made = _create(data, array_name(feature), rows[0])
        made.attrs.update({"names": list(episode.names[feature]), "units": list(episode.units[feature])})
        made.append(rows)
    if episode.subtasks:
        _create(data, "subtask_index", np.array(episode.subtask)[0]).append(np.array(episode.subtask))
    for camera, pictures in episode.cameras.items():
        _append_pictures(data, camera, pictures)
    for camera, pictures in episode.depths.items():
        _append_pictures(data, f"{camera}_depth", pictures).attrs["unit"] = pictures.unit


def _append_pictures(data: Any, name: str, pictures: Any) -> Any:
    """Create an array with the pictures of a camera, and return it."""
    made = _create(data, name, np.empty(pictures.size, dtype=pictures.dtype))
    for pixels in pictures:
        made.append(pixels[None])
    return made


def join_episodes(files: Sequence[Path], folder: Path) -> None:
    """Join the stores of one or more episodes in a new store ``folder``.

    Raises :class:`RecordingError` if the arrays of the stores differ.
    """
    root = zarr.open_group(str(folder), mode="w-", zarr_format=_ZARR_FORMAT)
    data, ends, about, first = root.create_group("data"), list[int](), list[dict[str, Any]](), ""
    for file in files:
        episode = zarr.open_group(str(file), mode="r")
        about.append(dict(episode.attrs))
        arrays = dict(episode["data"].arrays())
        recording = str(about[-1]["recording"])
        first = first or recording
        for name, rows in arrays.items():
            if not ends:
                _create(data, name, np.empty(rows.shape[1:], dtype=rows.dtype)).attrs.update(dict(rows.attrs))
            made = data.get(name)
            if made is None or made.shape[1:] != rows.shape[1:] or dict(made.attrs) != dict(rows.attrs):
                raise RecordingError(f"{recording}: its {name} differs from that of {first}")
            for begin in range(0, rows.shape[0], made.chunks[0]):
                made.append(rows[begin : begin + made.chunks[0]])
        if missing := set(data.array_keys()) - arrays.keys():
            raise RecordingError(f"{recording}: has no {min(missing)}, which {first} has")
        ends.append(arrays["action"].shape[0] + (ends[-1] if ends else 0))
    root.create_group("meta").create_array("episode_ends", data=np.array(ends, dtype=np.int64))
    root.attrs.update({"cell": about[0]["cell"], "fps": about[0]["fps"], "episodes": about})


def _create(group: Any, name: str, row: Any) -> Any:
    """Create an array without rows, with the shape and type of ``row``."""
    rows = _FRAMES_PER_CHUNK if row.ndim < 2 else 1
    return group.create_array(name, shape=(0, *row.shape), chunks=(rows, *row.shape), dtype=row.dtype)


ZARR = ExportFormat(write_episode, join_episodes, has_depth=True, ahead=1)
