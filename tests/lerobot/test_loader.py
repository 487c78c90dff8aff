"""LeRobot's own package reads what is written here, and writes the same files of the same frames.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")

import pyarrow.parquet
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from q2r2_control.export.lerobot import write_dataset
from tests.export.test_lerobot import EPISODES, NAMES

FPS = 30


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """A dataset of three episodes, written here."""
    files = [tmp_path / f"{index}.npz" for index in range(len(EPISODES))]
    for episode, file in zip(EPISODES, files, strict=True):
        episode.save(file)
    write_dataset(files, tmp_path / "ours")
    return tmp_path / "ours"


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """The same frames, written by the package."""
    vectors: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": (len(labels),), "names": list(labels)} for name, labels in NAMES.items()
    }
    flag = {"dtype": "bool", "shape": (1,), "names": None}
    features = {**vectors, "next.done": flag, "next.success": flag}
    folder = tmp_path / "theirs"
    dataset = LeRobotDataset.create("q2r2/test", FPS, features, root=folder, robot_type="two_arms", use_videos=False)
    for episode in EPISODES:
        for frame in range(episode.frames):
            values: dict[str, Any] = {name: episode.vectors[name][frame] for name in NAMES}
            done = np.array([frame == episode.frames - 1])
            dataset.add_frame(
                {**values, "next.done": done, "next.success": done & bool(episode.success), "task": episode.task}
            )
        dataset.save_episode()
    dataset.finalize()
    return folder


def files_in(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def same(found: Any, expected: Any, width: Any) -> bool:
    """Whether numbers are the same up to those of float32, and to ``width``."""
    return bool(np.all(np.abs(np.array(found, float) - np.array(expected, float)) <= np.array(width) + 1e-5))


def test_info_is_the_same(ours: Path, theirs: Path) -> None:
    found, expected = (json.loads((folder / "meta" / "info.json").read_text()) for folder in (ours, theirs))
    assert found == expected
    assert list(found) == list(expected)
    assert list(found["features"]) == list(expected["features"])


def test_files_have_the_same_names_columns_and_types(ours: Path, theirs: Path) -> None:
    assert files_in(ours) - files_in(theirs) == {"meta/recordings.json"}
    assert files_in(theirs) <= files_in(ours)
    for name in sorted(files_in(theirs)):
        if name.endswith(".parquet"):
            found, expected = (pyarrow.parquet.read_schema(folder / name) for folder in (ours, theirs))
            assert columns(found) == columns(expected), name


def columns(schema: pyarrow.Schema) -> list[tuple[str, str]]:
    """Names and types; which of the two kinds of strings pandas writes depends on its version."""
    return [(field.name, str(field.type).replace("large_string", "string")) for field in schema]


def test_frames_and_tasks_are_the_same_to_the_bit(ours: Path, theirs: Path) -> None:
    for name in ("data/chunk-000/file-000.parquet", "meta/tasks.parquet"):
        found, expected = (pyarrow.parquet.read_table(folder / name) for folder in (ours, theirs))
        assert found.to_pylist() == expected.to_pylist()


def test_statistics_are_the_same_up_to_a_bin_of_their_histograms(ours: Path, theirs: Path) -> None:
    # The package takes quantiles from histograms of 5000 bins.
    found, expected = (json.loads((folder / "meta" / "stats.json").read_text()) for folder in (ours, theirs))
    assert found.keys() == expected.keys()
    for feature, numbers in expected.items():
        assert found[feature].keys() == numbers.keys()
        reach = np.array(numbers["max"], float) - np.array(numbers["min"], float)
        for name, values in numbers.items():
            width = 2.0 * reach / 5000 if name.startswith("q") else 1e-6 * reach
            assert same(found[feature][name], values, width), (feature, name)


def test_what_is_said_of_episodes_is_the_same(ours: Path, theirs: Path) -> None:
    name = "meta/episodes/chunk-000/file-000.parquet"
    found, expected = (pyarrow.parquet.read_table(folder / name).to_pylist() for folder in (ours, theirs))
    for row, other in zip(found, expected, strict=True):
        for column, value in other.items():
            if not column.startswith("stats/"):
                assert row[column] == value, column
            elif not column.rsplit("/", 1)[1].startswith("q"):
                assert same(row[column], value, 1e-5 * np.abs(np.array(value, float))), column


def test_the_loader_reads_every_frame_and_its_neighbours(ours: Path) -> None:
    ahead = [(index + 1) / FPS for index in range(4)]
    dataset = LeRobotDataset("q2r2/test", root=ours, delta_timestamps={"action": ahead})
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 125, FPS)
    item = dataset[41]
    assert item["task"] == "circle"
    np.testing.assert_array_equal(item["observation.state"].numpy(), EPISODES[1].vectors["observation.state"][1])
    np.testing.assert_array_equal(item["action"].numpy(), EPISODES[1].vectors["action"][2:6])
    assert dataset[64]["action_is_pad"].all()


def test_batches_come_out_of_a_dataloader(ours: Path) -> None:
    loader = torch.utils.data.DataLoader(LeRobotDataset("q2r2/test", root=ours), batch_size=50)
    batches = list(loader)
    assert [len(batch["index"]) for batch in batches] == [50, 50, 25]
    states = torch.cat([batch["observation.state"] for batch in batches]).numpy()
    expected = np.concatenate([episode.vectors["observation.state"] for episode in EPISODES])
    np.testing.assert_array_equal(states, expected)


def test_one_episode_of_them_can_be_loaded(ours: Path) -> None:
    dataset = LeRobotDataset("q2r2/test", root=ours, episodes=[1])
    assert len(dataset) == 25
    assert dataset[0]["index"] == 40
