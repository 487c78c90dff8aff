"""A table has the columns of the dataset, a line a frame."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.export.csv_tables import write_table, write_tables, write_vectors
from tests.export.vectors import EPISODES, NAMES

HEAD = [
    *(f"{feature}.{name}" for feature, names in NAMES.items() for name in names),
    *("next.done", "next.success", "timestamp", "frame_index", "episode_index", "index", "task_index", "task"),
]


def read(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
    assert reader.fieldnames == HEAD
    return rows


def test_each_recording_has_a_file_with_a_line_for_each_frame(tmp_path: Path) -> None:
    files = [tmp_path / str(index) for index in range(len(EPISODES))]
    for episode, file in zip(EPISODES, files, strict=True):
        write_vectors(episode, file)
    write_tables(files, tmp_path / "made")
    assert sorted(file.name for file in (tmp_path / "made").iterdir()) == ["run-1.csv", "run-2.csv", "run-3.csv"]
    rows = read(tmp_path / "made" / "run-2.csv")
    values = [[row[f"action.{name}"] for name in NAMES["action"]] for row in rows]
    np.testing.assert_array_equal(np.array(values, dtype=np.float32), EPISODES[1].vectors["action"])
    assert [int(row["index"]) for row in rows] == list(range(40, 65))
    assert {(row["episode_index"], row["task_index"], row["task"]) for row in rows} == {("1", "1", "circle")}
    assert rows[-1]["next.done"] == "True"
    succeeded = [row["next.success"] for row in read(tmp_path / "made" / "run-1.csv")]
    assert [frame for frame, said in enumerate(succeeded) if said == "True"] == [EPISODES[0].frames - 1]


def test_two_recordings_of_one_name_are_refused(tmp_path: Path) -> None:
    write_vectors(EPISODES[0], tmp_path / "0")
    with pytest.raises(RecordingError, match=r"run-1\.mcap: two recordings have this name"):
        write_tables([tmp_path / "0"] * 2, tmp_path / "made")


def test_one_recording_can_be_one_file(tmp_path: Path) -> None:
    write_vectors(EPISODES[0], tmp_path / "0")
    write_table([tmp_path / "0"], tmp_path / "made.csv")
    assert len(read(tmp_path / "made.csv")) == EPISODES[0].frames
