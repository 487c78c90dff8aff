"""Writes episodes as HDF5 files, a file each, laid out as trainers of ACT read them.

The layout is that of ``record_sim_episodes.py`` in https://github.com/tonyzhaozh/act.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from q2r2_control.errors import ConfigError
from q2r2_control.export.episodes import EpisodeVectors

_AHEAD = 1  # frames by which actions are
# Name in the file, name of the feature, unit of a joint.
_DATA = (
    ("observations/qpos", "observation.state", "rad"),
    ("observations/qvel", "observation.velocity", "rad/s"),
    ("action", "action", "rad"),
)
_OPENING, _OPENING_UNIT = "_gripper", "0 closed .. 1 open"
_COMPRESSION = 1  # of gzip's levels, the fastest


def require_h5py() -> Any:
    """The module h5py. Raises :class:`ConfigError` where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise ConfigError("export hdf5 needs h5py: pip install 'q2r2_control[export]'") from error
    return h5py


def write_file(episode: EpisodeVectors, path: Path) -> None:
    """Write one episode."""
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


def gather_files(files: Sequence[Path], folder: Path) -> None:
    """Move kept episodes into a ``folder`` that is made, as ``episode_0.hdf5`` and so on."""
    folder.mkdir()
    for number, file in enumerate(files):
        file.replace(folder / f"episode_{number}.hdf5")
