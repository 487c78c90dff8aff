"""HDF5 files have what trainers of ACT look for, with the action that follows what is observed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.hdf5 import gather_files, write_file
from tests.export.vectors import CAMERA, EPISODES, HEIGHT, WIDTH, with_pictures

h5py = pytest.importorskip("h5py", reason="the extra export is not installed")

POSITIONS = ("left_A1", "left_gripper")


def act_episodes() -> list[EpisodeVectors]:
    """Two episodes with the features that ACT asks for, and the pictures of a camera."""
    names = {"observation.state": POSITIONS, "observation.velocity": POSITIONS[:1], "action": POSITIONS}
    return [
        replace(
            with_pictures(plain, number),
            names=names,
            vectors={
                name: plain.vectors["action"][:, : len(labels)] * (1 + at)
                for at, (name, labels) in enumerate(names.items())
            },
        )
        for number, plain in enumerate(EPISODES[:2])
    ]


def export(episodes: list[EpisodeVectors], folder: Path) -> Path:
    """Write episodes and return the folder in which they end."""
    folder.mkdir()
    files = [folder / str(number) for number in range(len(episodes))]
    for episode, file in zip(episodes, files, strict=True):
        write_file(episode, file)
    gather_files(files, folder / "made")
    return folder / "made"


def test_each_episode_is_a_file_with_positions_velocities_pictures_and_the_next_action(tmp_path: Path) -> None:
    made = export(episodes := act_episodes(), tmp_path / "out")
    for number, episode in enumerate(episodes):
        with h5py.File(made / f"episode_{number}.hdf5") as file:
            np.testing.assert_array_equal(file["observations/qpos"], episode.vectors["observation.state"])
            np.testing.assert_array_equal(file["observations/qvel"], episode.vectors["observation.velocity"])
            actions = episode.vectors["action"]
            np.testing.assert_array_equal(file["action"][:-1], actions[1:])
            np.testing.assert_array_equal(file["action"][-1], actions[-1])
            np.testing.assert_array_equal(file[f"observations/images/{CAMERA}"], list(episode.cameras[CAMERA]))
            assert file[f"observations/images/{CAMERA}"].chunks == (1, HEIGHT, WIDTH, 3)


def test_a_file_says_what_its_numbers_are(tmp_path: Path) -> None:
    with h5py.File(export(act_episodes(), tmp_path / "out") / "episode_0.hdf5") as file:
        assert list(file["observations/qpos"].attrs["names"]) == list(POSITIONS)
        assert list(file["observations/qpos"].attrs["units"]) == ["rad", "0 closed .. 1 open"]
        assert list(file["observations/qvel"].attrs["units"]) == ["rad/s"]
        about = dict(file.attrs)
    assert (about["fps"], about["task"], about["cell"], about["note_operator"]) == (30, "stack", "two_arms", "Ada")
    assert (about["recording"], about["sim"], about["action_ahead_frames"]) == ("run-1.mcap", True, 1)
