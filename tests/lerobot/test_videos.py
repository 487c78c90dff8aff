"""LeRobot's own package reads the videos that are written here, and says the same of the same pictures.

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

from q2r2_control.export.lerobot import video_key, write_dataset
from q2r2_control.export.pictures import Pixels
from tests.export.test_lerobot import EPISODES, NAMES
from tests.export.videos import CAMERA, HEIGHT, WIDTH, save_with_videos
from tests.lerobot.test_loader import FPS, columns, files_in, same

KEY = video_key(CAMERA)
BACKEND = "pyav"  # the default, torchcodec, needs the libraries of FFmpeg, which no wheel brings


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[list[Pixels]]]:
    """A dataset of three episodes with a video, written here, and its pictures."""
    folder = tmp_path_factory.mktemp("ours")
    files, pictures = save_with_videos(EPISODES, folder)
    write_dataset(files, folder / "made")
    return folder / "made", pictures


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory, ours: tuple[Path, list[list[Pixels]]]) -> Path:
    """The same frames and pictures, written by the package."""
    vectors: dict[str, dict[str, Any]] = {
        name: {"dtype": "float32", "shape": (len(labels),), "names": list(labels)} for name, labels in NAMES.items()
    }
    features = {
        **vectors,
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
        "next.success": {"dtype": "bool", "shape": (1,), "names": None},
        KEY: {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]},
    }
    folder = tmp_path_factory.mktemp("theirs") / "made"
    dataset = LeRobotDataset.create("q2r2/test", FPS, features, root=folder, robot_type="two_arms", use_videos=True)
    for episode, pictures in zip(EPISODES, ours[1], strict=True):
        for frame, pixels in enumerate(pictures):
            values: dict[str, Any] = {name: episode.vectors[name][frame] for name in NAMES}
            done = np.array([frame == episode.frames - 1])
            flags = {"next.done": done, "next.success": done & bool(episode.success)}
            dataset.add_frame({**values, **flags, KEY: pixels, "task": episode.task})
        dataset.save_episode()
    dataset.finalize()
    return folder


def test_what_is_said_of_the_dataset_is_the_same(ours: tuple[Path, list[list[Pixels]]], theirs: Path) -> None:
    found, expected = (json.loads((folder / "meta" / "info.json").read_text()) for folder in (ours[0], theirs))
    assert found == expected
    assert files_in(ours[0]) - files_in(theirs) == {"meta/recordings.json"}
    assert files_in(theirs) - files_in(ours[0]) == set()


def test_what_is_said_of_episodes_is_the_same_but_for_deviations_which_the_package_takes_of_squares_in_bytes(
    ours: tuple[Path, list[list[Pixels]]], theirs: Path
) -> None:
    name = "meta/episodes/chunk-000/file-000.parquet"
    tables = [pyarrow.parquet.read_table(folder / name) for folder in (ours[0], theirs)]
    assert sorted(columns(tables[0].schema)) == sorted(columns(tables[1].schema))
    for row, other in zip(*(table.to_pylist() for table in tables), strict=True):
        for column, value in other.items():
            if column.startswith(f"videos/{KEY}/"):
                assert row[column] == pytest.approx(value, abs=1e-6), column
            elif column.startswith(f"stats/{KEY}/") and not column.endswith("/std"):
                # The package takes quantiles from histograms.
                assert same(row[column], value, 1.01 / 255 if "/q" in column else 1e-6), column


def test_the_loader_gives_every_frame_its_picture(ours: tuple[Path, list[list[Pixels]]]) -> None:
    folder, pictures = ours
    dataset = LeRobotDataset("q2r2/test", root=folder, delta_timestamps={KEY: [-1 / FPS, 0.0]}, video_backend=BACKEND)
    expected = [pixels for episode in pictures for pixels in episode]
    for index in (1, 39, 41, 64, 66, 124):
        found = dataset[index][KEY].numpy().transpose(0, 2, 3, 1) * 255
        for pixels, wanted in zip(found, expected[index - 1 : index + 1], strict=True):
            assert np.abs(pixels - wanted).mean() < 6, index


def test_batches_with_pictures_come_out_of_a_dataloader(ours: tuple[Path, list[list[Pixels]]]) -> None:
    loader = torch.utils.data.DataLoader(
        LeRobotDataset("q2r2/test", root=ours[0], video_backend=BACKEND), batch_size=50
    )
    shapes = [tuple(batch[KEY].shape) for batch in loader]
    assert shapes == [(count, 3, HEIGHT, WIDTH) for count in (50, 50, 25)]
