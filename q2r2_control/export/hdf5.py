"""Writes episodes as HDF5 files, a file each, laid out as trainers of ACT read them.

The layout is that of ``record_sim_episodes.py`` in https://github.com/tonyzhaozh/act.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.kept_pictures import KeptAs, place_of
from q2r2_control.export.pixel_files import PICTURES, require_h5py

_AHEAD = 1  # frames by which actions are
# Name in the file, name of the feature, unit of a joint.
_DATA = (
    ("observations/qpos", "observation.state", "rad"),
    ("observations/qvel", "observation.velocity", "rad/s"),
    ("action", "action", "rad"),
)
_OPENING, _OPENING_UNIT = "_gripper", "0 closed .. 1 open"


def write_episodes(files: Sequence[Path], folder: Path) -> None:
    """Write kept episodes into a ``folder`` that is made, as ``episode_0.hdf5`` and so on."""
    folder.mkdir()
    for number, file in enumerate(files):
        _write(EpisodeVectors.load(file), file, folder / f"episode_{number}.hdf5")


def _write(episode: EpisodeVectors, kept: Path, path: Path) -> None:
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
        for camera in episode.cameras:
            with require_h5py().File(place_of(kept, camera, KeptAs.PIXELS)) as source:
                source.copy(PICTURES, images, name=camera)
            images[camera].attrs["axes"] = ["frame", "row", "column", "r g b"]
