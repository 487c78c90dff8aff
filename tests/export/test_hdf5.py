"""HDF5 files have what trainers of ACT look for, with the action that follows what is observed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.hdf5 import write_episodes
from q2r2_control.export.kept_pictures import KeptAs, KeptPictures, place_of
from q2r2_control.export.pixel_files import write_pixels
from tests.export.runs import contents
from tests.export.test_lerobot import EPISODES
from tests.export.videos import CAMERA, HEIGHT, WIDTH, pictures_of

pytestmark = pytest.mark.slow

h5py = pytest.importorskip("h5py", reason="the extra export is not installed")

POSITIONS = ("left_A1", "left_gripper")


def kept(folder: Path) -> tuple[list[Path], list[EpisodeVectors]]:
    """Files of two episodes with the pictures of a camera."""
    camera = CameraConfig(position=(1, 0, 1), rpy=(0, 0, 0), width=WIDTH, height=HEIGHT)
    files, episodes = [], []
    for number, plain in enumerate(EPISODES[:2]):
        names = {"observation.state": POSITIONS, "observation.velocity": POSITIONS[:1], "action": POSITIONS}
        vectors = {
            name: plain.vectors["action"][:, : len(labels)] * (1 + at)
            for at, (name, labels) in enumerate(names.items())
        }
        cameras = {CAMERA: KeptPictures(WIDTH, HEIGHT, {})}
        episode, file = replace(plain, names=names, vectors=vectors, cameras=cameras), folder / f"{number}.npz"
        write_pixels(pictures_of(episode, number), episode.frames, camera, place_of(file, CAMERA, KeptAs.PIXELS))
        episode.save(file)
        files.append(file)
        episodes.append(episode)
    return files, episodes


def test_each_episode_is_a_file_with_positions_velocities_pictures_and_the_next_action(tmp_path: Path) -> None:
    files, episodes = kept(tmp_path)
    write_episodes(files, tmp_path / "made")
    for number, episode in enumerate(episodes):
        with h5py.File(tmp_path / "made" / f"episode_{number}.hdf5") as file:
            np.testing.assert_array_equal(file["observations/qpos"], episode.vectors["observation.state"])
            np.testing.assert_array_equal(file["observations/qvel"], episode.vectors["observation.velocity"])
            actions = episode.vectors["action"]
            np.testing.assert_array_equal(file["action"][:-1], actions[1:])
            np.testing.assert_array_equal(file["action"][-1], actions[-1])
            np.testing.assert_array_equal(file[f"observations/images/{CAMERA}"], pictures_of(episode, number))
            assert file[f"observations/images/{CAMERA}"].chunks == (1, HEIGHT, WIDTH, 3)


def test_a_file_says_what_its_numbers_are(tmp_path: Path) -> None:
    files, _ = kept(tmp_path)
    write_episodes(files, tmp_path / "made")
    with h5py.File(tmp_path / "made" / "episode_0.hdf5") as file:
        assert list(file["observations/qpos"].attrs["names"]) == list(POSITIONS)
        assert list(file["observations/qpos"].attrs["units"]) == ["rad", "0 closed .. 1 open"]
        assert list(file["observations/qvel"].attrs["units"]) == ["rad/s"]
        about = dict(file.attrs)
    assert (about["fps"], about["task"], about["cell"], about["note_operator"]) == (30, "stack", "two_arms", "Ada")
    assert (about["recording"], about["sim"], about["action_ahead_frames"]) == ("run-1.mcap", True, 1)


def test_the_same_episodes_give_the_same_bytes(tmp_path: Path) -> None:
    files, _ = kept(tmp_path)
    for name in ("one", "two"):
        write_episodes(files, tmp_path / name)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
