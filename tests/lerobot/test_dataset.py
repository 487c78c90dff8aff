"""LeRobot's own loader reads exported datasets: every number, every picture, and all metadata.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")

import pyarrow.parquet
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from q2r2_control.export.dataset_card import CARD, SOURCES
from q2r2_control.export.lerobot import join_shards, video_key, write_shard
from q2r2_control.export.sampling import Pixels
from tests.export.files import CAMERA, EPISODES, HEIGHT, NAMES, TOLD, WIDTH, contents, record_two, with_pictures
from tests.export.test_formats import export

ROOT = Path(__file__).resolve().parents[2]
FPS = 30
KEY = video_key(CAMERA)
SEEN = [with_pictures(episode, number) for number, episode in enumerate(EPISODES)]
SPANS = [(0, 40), (40, 65), (65, 125)]  # First frame of each episode, and first frame after it.
BACKEND = "pyav"  # The default, torchcodec, needs the libraries of FFmpeg, which no wheel contains.


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export("lerobot", EPISODES, tmp_path_factory.mktemp("vectors"), ["1", "2", "3"])


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export("lerobot", SEEN, tmp_path_factory.mktemp("pictures"), ["1", "2", "3"])


def rows_of(folder: Path) -> list[dict[str, object]]:
    (file,) = (folder / "meta" / "episodes").rglob("*.parquet")
    rows: list[dict[str, object]] = pyarrow.parquet.read_table(file).to_pylist()
    return rows


def test_info_json_names_every_number_and_has_the_counts_of_episodes_frames_and_tasks(dataset: Path) -> None:
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", FPS, "two_arms")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 125, 2)
    assert info["splits"] == {"train": "0:3"}
    for name, labels in NAMES.items():
        known = [f"{label}.pos" for label in labels]  # lerobot's commands look for these names.
        assert info["features"][name] == {"dtype": "float32", "shape": [len(labels)], "names": known}
    for name in ("next.done", "next.success"):
        assert info["features"][name] == {"dtype": "bool", "shape": [1], "names": None}


def test_the_readme_has_the_unit_of_every_number_under_its_name_in_the_dataset(dataset: Path) -> None:
    card, info = (dataset / CARD).read_text(), json.loads((dataset / "meta" / "info.json").read_text())
    for name in NAMES:
        (row,) = (line for line in card.splitlines() if line.startswith(f"| `{name}` |"))
        assert all(label in row for label in info["features"][name]["names"])
        assert row.endswith("] |")


def test_every_episode_has_its_frames_its_task_and_its_recording(dataset: Path) -> None:
    rows = rows_of(dataset)
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == SPANS
    assert [row["tasks"] for row in rows] == [["stack"], ["circle"], ["stack"]]
    sources = json.loads((dataset / SOURCES).read_text())
    assert [(one["episode_index"], one["recording"], one["success"], one["operator"]) for one in sources] == [
        (0, "run-1.mcap", True, "Ada"),
        (1, "run-2.mcap", None, "Ada"),
        (2, "run-3.mcap", False, "Ada"),
    ]


def test_the_loader_reads_every_frame_with_its_neighbours_and_the_ends_and_successes_of_episodes(dataset: Path) -> None:
    ahead = [(index + 1) / FPS for index in range(4)]
    loaded = LeRobotDataset("q2r2/test", root=dataset, delta_timestamps={"action": ahead})
    assert (loaded.num_episodes, loaded.num_frames, loaded.fps) == (3, 125, FPS)
    item = loaded[41]
    assert item["task"] == "circle"
    np.testing.assert_array_equal(item["action"].numpy(), EPISODES[1].vectors["action"][2:6])
    items = [loaded[index] for index in range(125)]
    found = np.stack([item["observation.state"].numpy() for item in items])
    np.testing.assert_array_equal(found, np.concatenate([one.vectors["observation.state"] for one in EPISODES]))
    assert [index for index, item in enumerate(items) if item["next.done"]] == [39, 64, 124]
    assert [index for index, item in enumerate(items) if item["next.success"]] == [39]


def test_the_loader_tells_the_subtask_of_every_frame(tmp_path: Path) -> None:
    made = export("lerobot", TOLD, tmp_path, ["1", "2", "3"])
    names = pyarrow.parquet.read_table(made / "meta/subtasks.parquet").to_pydict()
    assert names == {"subtask_index": [0, 1, 2, 3], "subtask": ["reach", "grasp the cube", "place", ""]}
    loaded = LeRobotDataset("q2r2/test", root=made)
    expected = [0] * 15 + [1] * 35 + [2] * 15 + [3] * 60
    assert [int(loaded[index]["subtask_index"]) for index in range(125)] == expected
    if find_spec("lerobot.datasets.language_render") is None:  # Up to lerobot 0.5, the loader adds the names.
        assert [loaded[index]["subtask"] for index in (0, 15, 40, 50)] == [names["subtask"][at] for at in (0, 1, 1, 2)]
        return
    from lerobot.datasets.language_render import active_at

    for index in (0, 14, 15, 39, 40, 49, 50, 64):
        frame = loaded[index]
        row = active_at(float(frame["timestamp"]), persistent=frame["language_persistent"], style="subtask")
        assert row["content"] == names["subtask"][expected[index]]
    assert (loaded[70]["language_persistent"], loaded[0]["language_events"]) == ([], [])


def test_the_loader_gives_every_frame_its_picture(film: Path) -> None:
    spans = [(row[f"videos/{KEY}/from_timestamp"], row[f"videos/{KEY}/to_timestamp"]) for row in rows_of(film)]
    for found, frames in zip(spans, SPANS, strict=True):
        assert found == pytest.approx([frame / FPS for frame in frames], abs=1e-4)
    loaded = LeRobotDataset("q2r2/test", root=film, delta_timestamps={KEY: [-1 / FPS, 0.0]}, video_backend=BACKEND)
    expected: list[Pixels] = [pixels for episode in SEEN for pixels in episode.cameras[CAMERA]]
    for index in (1, 39, 41, 64, 66, 124):
        found = loaded[index][KEY].numpy().transpose(0, 2, 3, 1) * 255
        for pixels, wanted in zip(found, expected[index - 1 : index + 1], strict=True):
            assert pixels.shape == (HEIGHT, WIDTH, 3)
            assert np.abs(pixels - wanted).mean() < 6, index


def test_equal_episodes_give_a_dataset_with_equal_bytes_even_after_an_interrupted_export(
    film: Path, tmp_path: Path
) -> None:
    (tmp_path / "again").mkdir()
    shards = [tmp_path / "again" / str(number) for number in range(len(SEEN))]
    for episode, shard in zip(SEEN, shards, strict=True):
        shard.mkdir()
        (shard / "half").touch()
        write_shard(episode, shard)
    join_shards(shards, tmp_path / "whole")
    assert contents(tmp_path / "whole") == contents(film)


def test_while_a_video_is_encoded_no_thread_has_priority_over_a_control_loop(tmp_path: Path) -> None:
    seen: set[int] = set()
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.001):
            for thread in os.listdir("/proc/self/task"):
                try:
                    seen.add(os.sched_getscheduler(int(thread)))
                except OSError:
                    continue  # The thread has ended.

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        write_shard(SEEN[0], tmp_path / "made")
    finally:
        over.set()
        watcher.join()
    assert seen == {os.SCHED_OTHER}


def test_the_docs_name_every_feature_of_an_exported_dataset(tmp_path: Path) -> None:
    record_two(tmp_path / "recordings")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "q2r2_control", "export", "lerobot", str(tmp_path / "recordings")]
    run = subprocess.run([*command, "--output", str(out), "--workers", "2"], capture_output=True, text=True)
    assert (run.returncode, run.stdout) == (0, f"{out}: 2 of 2 recordings at 30 frames per second\n")
    assert "%|" not in run.stderr  # The package's own progress bar is not shown.
    info = json.loads((out / "meta/info.json").read_text())
    names = [line.split("|")[1] for line in (ROOT / "docs/recording.md").read_text().splitlines() if "| `" in line]
    documented = {name for cell in names for name in cell.replace("`", " ").replace(",", " ").split()}
    assert set(info["features"]) <= documented
    assert info["robot_type"] == "dual_iiwa7"
