"""An output is there whole or not at all."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.export.kept_episodes import Output


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
