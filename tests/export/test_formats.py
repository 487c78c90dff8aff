"""The CSV files and HDF5 files of an export have the numbers of its episodes."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.export import lerobot
from q2r2_control.export.dataset_card import SOURCES
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.formats import FORMATS, ROBOMIMIC
from q2r2_control.export.lerobot import join_shards, video_key
from q2r2_control.extras import install_line
from tests.cli.command import q2r2
from tests.export.files import CAMERA, EPISODES, HEIGHT, NAMES, TOLD, WIDTH, with_pictures

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


def export(name: str, episodes: Sequence[EpisodeVectors], folder: Path, recordings: Sequence[str]) -> Path:
    files = [folder / f"{recording}.{number}" for number, recording in enumerate(recordings)]
    for episode, file in zip(episodes, files, strict=False):
        FORMATS[name].write(episode, file)
    FORMATS[name].join(files, folder / "made")
    return folder / "made"


def test_each_recording_becomes_a_table_with_a_line_for_each_frame(tmp_path: Path) -> None:
    made = export("csv", EPISODES, tmp_path, ["run-1", "run-2", "run-3"])
    assert sorted(file.name for file in made.iterdir()) == ["run-1.csv", "run-2.csv", "run-3.csv", "units.json"]
    rows = read(made / "run-2.csv")
    values = [[row[f"action.{name}"] for name in NAMES["action"]] for row in rows]
    np.testing.assert_array_equal(np.array(values, dtype=np.float32), EPISODES[1].vectors["action"])
    assert [int(row["frame_index"]) for row in rows] == list(range(25))
    assert {row["task"] for row in rows} == {"circle"}
    assert rows[-1]["next.done"] == "True"
    succeeded = [row["next.success"] for row in read(made / "run-1.csv")]
    assert [frame for frame, said in enumerate(succeeded) if said == "True"] == [EPISODES[0].frames - 1]


def test_a_file_beside_the_tables_has_the_unit_of_each_column_of_numbers(tmp_path: Path) -> None:
    units = json.loads((export("csv", EPISODES, tmp_path, ["run-1"]) / "units.json").read_text())
    numbers = {
        f"{feature}.{name}": unit
        for feature, names in EPISODES[0].units.items()
        for name, unit in zip(NAMES[feature], names, strict=True)
    }
    assert units == {"timestamp": "s"} | numbers
    assert {"rad", "0 closed .. 1 open"} <= set(units.values())


def test_two_recordings_with_the_same_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"run\.mcap: two recordings have this name"):
        export("csv", EPISODES, tmp_path, ["run", "run"])


def test_a_table_has_the_subtask_of_each_line(tmp_path: Path) -> None:
    made = export("csv", TOLD, tmp_path, ["run-1", "run-2", "run-3"])
    with (made / "run-2.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == [*HEAD, "subtask_index", "subtask"]
    found = [(int(row["subtask_index"]), row["subtask"]) for row in rows]
    assert found == [(0, "grasp the cube")] * 10 + [(1, "place")] * 15
    # ``read`` checks that this file has no columns for subtasks.
    assert len(read(made / "run-3.csv")) == TOLD[2].frames


POSITIONS = ("left_A1", "left_gripper")
NAMES_FOR_ACT = {"observation.state": POSITIONS, "observation.velocity": POSITIONS[:1], "action": POSITIONS}
EPISODES_FOR_ACT = [
    replace(
        with_pictures(plain, number),
        ahead=2,
        names=NAMES_FOR_ACT,
        vectors={
            name: plain.vectors["action"][:, : len(labels)] * (1 + at)
            for at, (name, labels) in enumerate(NAMES_FOR_ACT.items())
        },
    )
    for number, plain in enumerate(EPISODES[:2])
]


def test_each_episode_becomes_an_hdf5_file_with_the_data_that_act_needs(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra export is not installed")
    made = export("hdf5", EPISODES_FOR_ACT, tmp_path, ["a", "b"])
    for number, episode in enumerate(EPISODES_FOR_ACT):
        with h5py.File(made / f"episode_{number}.hdf5") as file:
            state, pictures = file["observations/qpos"], file[f"observations/images/{CAMERA}"]
            np.testing.assert_array_equal(state, episode.vectors["observation.state"])
            np.testing.assert_array_equal(file["observations/qvel"], episode.vectors["observation.velocity"])
            np.testing.assert_array_equal(file["action"], episode.vectors["action"])
            np.testing.assert_array_equal(pictures, list(episode.cameras[CAMERA]))
            assert pictures.chunks == (1, HEIGHT, WIDTH, 3)
            assert list(state.attrs["names"]) == list(POSITIONS)
            assert list(state.attrs["units"]) == ["rad", "0 closed .. 1 open"]
            assert list(file["observations/qvel"].attrs["units"]) == ["rad/s"]
            about = dict(file.attrs)
            assert (about["fps"], about["task"], about["cell"]) == (30, episode.task, "two_arms")
            assert (about["recording"], about["note_operator"]) == (f"run-{number + 1}.mcap", "Ada")
            assert (about["sim"], about["action_ahead_frames"], about.get("success")) == (1, 2, episode.success)


def test_an_hdf5_file_has_the_subtask_of_each_frame_and_the_names_of_the_subtasks(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra export is not installed")
    told = [
        replace(plain, subtasks=with_them.subtasks, subtask=with_them.subtask)
        for plain, with_them in zip(EPISODES_FOR_ACT, TOLD, strict=False)
    ]
    made = export("hdf5", told, tmp_path, ["a", "b"])
    with h5py.File(made / "episode_1.hdf5") as file:
        assert file["subtask_index"][:].tolist() == [0] * 10 + [1] * 15
        assert list(file["subtask_index"].attrs["names"]) == ["grasp the cube", "place"]


def test_one_file_with_links_to_all_episodes_gives_robomimic_the_same_numbers(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra export is not installed")
    made = export("hdf5", EPISODES_FOR_ACT, tmp_path, ["a", "b"])
    moved = made.rename(tmp_path / "elsewhere")
    with h5py.File(moved / ROBOMIMIC) as file:
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "two_arms"
        assert file["data"].attrs["total"] == 65
        for number, episode in enumerate(EPISODES_FOR_ACT):
            demo = file[f"data/demo_{number}"]
            assert demo.attrs["num_samples"] == episode.frames
            np.testing.assert_array_equal(demo["obs/qpos"], episode.vectors["observation.state"])
            np.testing.assert_array_equal(demo["actions"], episode.vectors["action"])
            np.testing.assert_array_equal(demo[f"obs/{CAMERA}"], list(episode.cameras[CAMERA]))
            assert np.flatnonzero(demo["dones"]).tolist() == [episode.frames - 1]
            assert demo["rewards"][-1] == bool(episode.success)


ACTION = {"dtype": "float32", "shape": [2], "names": ["left_A1", "left_A2"]}
OTHER_ACTION = {**ACTION, "names": ["left_A1", "left_A3"]}
VIDEO = {"dtype": "video", "shape": [48, 64, 3]}


def shard(folder: Path, recording: str, cell: str, features: dict[str, Any]) -> Path:
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"robot_type": cell, "features": features}))
    (folder / SOURCES).write_text(json.dumps([{"recording": recording}]))
    return folder


@pytest.mark.parametrize(
    ("cell", "features", "what"),
    [
        pytest.param("one_arm", {"action": ACTION}, r"of cell one_arm, but a\.mcap of two_arms", id="another cell"),
        pytest.param("two_arms", {"action": OTHER_ACTION}, r"action has not the numbers", id="another joint"),
        pytest.param("two_arms", {"action": ACTION, video_key(CAMERA): VIDEO}, "has not the cameras", id="a camera"),
    ],
)
def test_episodes_of_different_robots_are_not_joined_to_one_dataset(
    cell: str, features: dict[str, Any], what: str, tmp_path: Path
) -> None:
    shards = [
        shard(tmp_path / "a", "a.mcap", "two_arms", {"action": ACTION}),
        shard(tmp_path / "b", "b.mcap", cell, features),
    ]
    with pytest.raises(RecordingError, match=rf"b\.mcap: {what}"):
        join_shards(shards, tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_without_lerobot_one_line_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot, "find_spec", lambda name: None)
    (tmp_path / "a.mcap").touch()
    result = q2r2("export", "lerobot", str(tmp_path / "a.mcap"), "--output", str(tmp_path / "out"))
    assert result.exit_code == 2
    assert result.stderr == f"q2r2: export lerobot needs lerobot: {install_line('lerobot')}\n"
    assert not list(tmp_path.glob("out*"))
