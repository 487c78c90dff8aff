"""Paths that a user gives, as files of recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.recording.reader import recordings_in


def test_folders_are_searched_by_name_and_nothing_is_taken_twice(tmp_path: Path) -> None:
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.mcap").touch()
    first, second = tmp_path / "a" / "a.mcap", tmp_path / "b" / "b.mcap"
    assert recordings_in([tmp_path]) == [first, second]
    assert recordings_in([second, tmp_path]) == [second, first]
    (tmp_path / "empty").mkdir()
    for path, what in ((tmp_path / "empty", "no file .mcap in it"), (tmp_path / "missing", "no such file or folder")):
        with pytest.raises(RecordingError, match=f"{path.name}: {what}"):
            recordings_in([path])
