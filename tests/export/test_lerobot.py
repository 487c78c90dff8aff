"""A dataset has the files, names and numbers of LeRobot's format, whole or not at all."""

from __future__ import annotations

import builtins
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export import lerobot
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.lerobot import require_pyarrow, write_dataset
from q2r2_control.export.output import Output
from q2r2_control.export.statistics import statistics_of

pytestmark = pytest.mark.slow

NAMES = {"observation.state": ("left_A1", "left_gripper"), "action": ("left_A1", "left_gripper", "right_A1")}


OUTCOMES = {1: True, 2: None, 3: False}


def episode(seed: int, frames: int, task: str) -> EpisodeVectors:
    random = np.random.default_rng(seed)
    vectors = {name: random.normal(size=(frames, len(labels))).astype(np.float32) for name, labels in NAMES.items()}
    return EpisodeVectors(
        f"run-{seed}.mcap", "two_arms", task, 30, NAMES, {"operator": "Ada"}, vectors, success=OUTCOMES[seed]
    )


EPISODES = (episode(1, 40, "stack"), episode(2, 25, "circle"), episode(3, 60, "stack"))


@pytest.fixture
def kept(tmp_path: Path) -> list[Path]:
    """Files of three episodes."""
    files = [tmp_path / f"{index}.npz" for index in range(len(EPISODES))]
    for made, file in zip(EPISODES, files, strict=True):
        made.save(file)
    return files


@pytest.fixture
def pyarrow() -> Any:
    pytest.importorskip("pyarrow", reason="the extra export is not installed")
    return require_pyarrow()


def column(table: Any, name: str) -> npt.NDArray[Any]:
    return np.array(table.column(name).to_pylist())


def test_frames_are_in_one_file_in_the_order_of_the_episodes(kept: list[Path], tmp_path: Path, pyarrow: Any) -> None:
    write_dataset(kept, tmp_path / "made")
    table = pyarrow.parquet.read_table(tmp_path / "made" / "data" / "chunk-000" / "file-000.parquet")
    for name in NAMES:
        assert table.schema.field(name).type == pyarrow.list_(pyarrow.float32(), len(NAMES[name]))
        expected = np.concatenate([made.vectors[name] for made in EPISODES])
        np.testing.assert_array_equal(column(table, name).astype(np.float32), expected)
    assert column(table, "index").tolist() == list(range(125))
    assert column(table, "episode_index").tolist() == [0] * 40 + [1] * 25 + [2] * 60
    assert column(table, "task_index").tolist() == [0] * 40 + [1] * 25 + [0] * 60
    assert column(table, "frame_index").tolist() == [*range(40), *range(25), *range(60)]
    assert np.flatnonzero(column(table, "next.done")).tolist() == [39, 64, 124]
    assert np.flatnonzero(column(table, "next.success")).tolist() == [39]
    assert column(table, "timestamp")[39] == pytest.approx(39 / 30)


def test_info_says_what_is_in_it(kept: list[Path], tmp_path: Path, pyarrow: Any) -> None:
    write_dataset(kept, tmp_path / "made")
    info = json.loads((tmp_path / "made" / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["robot_type"], info["splits"]) == (30, "two_arms", {"train": "0:3"})
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 125, 2)
    assert info["features"]["action"] == {"dtype": "float32", "shape": [3], "names": list(NAMES["action"])}
    for name in ("next.done", "next.success"):
        assert info["features"][name] == {"dtype": "bool", "shape": [1], "names": None}
    assert info["data_path"].format(chunk_index=0, file_index=0) == "data/chunk-000/file-000.parquet"
    assert info["video_path"] is None
    sources = json.loads((tmp_path / "made" / "meta" / "recordings.json").read_text())
    assert sources[1] == {"episode_index": 1, "recording": "run-2.mcap", "success": None, "operator": "Ada"}


def test_episodes_say_where_their_frames_are_and_what_is_in_them(
    kept: list[Path], tmp_path: Path, pyarrow: Any
) -> None:
    write_dataset(kept, tmp_path / "made")
    rows = pyarrow.parquet.read_table(tmp_path / "made" / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    spans = [(row["dataset_from_index"], row["dataset_to_index"], row["length"]) for row in rows]
    assert spans == [(0, 40, 40), (40, 65, 25), (65, 125, 60)]
    assert [row["tasks"] for row in rows] == [["stack"], ["circle"], ["stack"]]
    assert all(row["data/chunk_index"] == row["data/file_index"] == 0 for row in rows)
    for made, row in zip(EPISODES, rows, strict=True):
        for name, values in statistics_of(made.vectors["action"]).items():
            assert row[f"stats/action/{name}"] == pytest.approx(values.tolist())
    together = json.loads((tmp_path / "made" / "meta" / "stats.json").read_text())
    everything = np.concatenate([made.vectors["action"] for made in EPISODES])
    assert together["action"]["std"] == pytest.approx(everything.std(axis=0, dtype=np.float64).tolist())
    assert together["index"]["max"] == [124]


def test_tasks_are_a_table_whose_index_is_their_text(kept: list[Path], tmp_path: Path, pyarrow: Any) -> None:
    pandas = pytest.importorskip("pandas")
    write_dataset(kept, tmp_path / "made")
    tasks = pandas.read_parquet(tmp_path / "made" / "meta" / "tasks.parquet")
    assert tasks.index.tolist() == ["stack", "circle"]
    assert tasks["task_index"].tolist() == [0, 1]


def test_an_episode_that_does_not_fit_begins_a_new_file_and_a_full_folder_a_new_one(
    kept: list[Path], tmp_path: Path, pyarrow: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "FILE_SIZE", 0)
    monkeypatch.setattr(lerobot, "FILES_PER_CHUNK", 2)
    write_dataset(kept, tmp_path / "made")
    files = sorted((tmp_path / "made" / "data").rglob("*.parquet"))
    places = [str(file.relative_to(tmp_path / "made" / "data")) for file in files]
    assert places == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    assert [pyarrow.parquet.read_metadata(file).num_rows for file in files] == [40, 25, 60]
    rows = pyarrow.parquet.read_table(tmp_path / "made" / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["data/chunk_index"], row["data/file_index"]) for row in rows] == [(0, 0), (0, 1), (1, 0)]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        pytest.param({"cell": "one_arm"}, r"of cell one_arm, but run-1\.mcap of two_arms", id="another cell"),
        pytest.param(
            {"names": {**NAMES, "action": ("left_A1", "left_gripper", "right_A2")}},
            r"action has not the numbers that run-1\.mcap has",
            id="another joint",
        ),
    ],
)
def test_episodes_of_different_robots_are_not_one_dataset(
    change: dict[str, Any], what: str, kept: list[Path], tmp_path: Path, pyarrow: Any
) -> None:
    replace(EPISODES[1], **change).save(kept[1])
    with pytest.raises(RecordingError, match=rf"run-2\.mcap: {what}"):
        write_dataset(kept, tmp_path / "made")


def test_without_pyarrow_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("pyarrow"):
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"needs pyarrow: pip install 'q2r2_control\[export\]'"):
        require_pyarrow()


def test_an_output_that_was_interrupted_is_not_there_and_a_second_try_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "below" / "made"

    def write(target: Path) -> None:
        target.mkdir()
        (target / "half").touch()
        raise KeyboardInterrupt

    output = Output(path)
    (output.episodes() / "0.npz").touch()
    with pytest.raises(KeyboardInterrupt):
        output.write(write)
    assert not path.exists()
    again = Output(path)
    assert [file.name for file in again.episodes().iterdir()] == ["0.npz"]
    again.write(lambda target: target.mkdir())
    assert list(path.iterdir()) == []
    assert list(path.parent.iterdir()) == [path]


def test_an_output_that_exists_or_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ConfigError, match="there: exists; allowed: a name that does not exist yet"):
        Output(tmp_path / "there")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"--output .*file/made: Not a directory"):
        Output(tmp_path / "file" / "made").episodes()
    late = Output(tmp_path / "late")
    late.episodes()

    def meanwhile(target: Path) -> None:
        target.mkdir()
        shutil.copytree(tmp_path / "there", tmp_path / "late")

    with pytest.raises(ConfigError, match="late: exists"):
        late.write(meanwhile)
