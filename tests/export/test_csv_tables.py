"""A table has the numbers of the dataset, a line a frame."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.export.csv_tables import gather_tables, move_table, write_table
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.hdf5 import gather_files, write_file
from tests.export.vectors import CAMERA, EPISODES, HEIGHT, NAMES, WIDTH, with_pictures

HEAD = [
    *(f"{feature}.{name}" for feature, names in NAMES.items() for name in names),
    *("next.done", "next.success", "timestamp", "frame_index", "task"),
]


def read(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
    assert reader.fieldnames == HEAD
    return rows


def kept(folder: Path, names: list[str]) -> list[Path]:
    """Tables as an export keeps them until all are there."""
    files = [folder / f"{name}.{number}" for number, name in enumerate(names)]
    for episode, file in zip(EPISODES, files, strict=False):
        write_table(episode, file)
    return files


def test_each_recording_has_a_file_with_a_line_for_each_frame(tmp_path: Path) -> None:
    gather_tables(kept(tmp_path, ["run-1", "run-2", "run-3"]), tmp_path / "made")
    assert sorted(file.name for file in (tmp_path / "made").iterdir()) == ["run-1.csv", "run-2.csv", "run-3.csv"]
    rows = read(tmp_path / "made" / "run-2.csv")
    values = [[row[f"action.{name}"] for name in NAMES["action"]] for row in rows]
    np.testing.assert_array_equal(np.array(values, dtype=np.float32), EPISODES[1].vectors["action"])
    assert [int(row["frame_index"]) for row in rows] == list(range(25))
    assert {row["task"] for row in rows} == {"circle"}
    assert rows[-1]["next.done"] == "True"
    succeeded = [row["next.success"] for row in read(tmp_path / "made" / "run-1.csv")]
    assert [frame for frame, said in enumerate(succeeded) if said == "True"] == [EPISODES[0].frames - 1]


def test_two_recordings_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"run\.mcap: two recordings have this name"):
        gather_tables(kept(tmp_path, ["run", "run"]), tmp_path / "made")


def test_one_episode_can_be_one_file_and_several_cannot(tmp_path: Path) -> None:
    move_table(kept(tmp_path, ["run"]), tmp_path / "made.csv")
    assert len(read(tmp_path / "made.csv")) == EPISODES[0].frames
    with pytest.raises(RecordingError, match="for 2 episodes"):
        move_table(kept(tmp_path, ["run", "other"]), tmp_path / "made.csv")


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
