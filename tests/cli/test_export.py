"""Recordings become datasets from the command line, as a user does it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.export.export_format import ExportFormat
from q2r2_control.export.formats import FORMATS, write_table
from tests.cli.command import q2r2
from tests.export.files import DURATION, contents, record_two
from tests.recording.runs import rewrite


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Sequence[Path]:
    """Return the files of two runs, each in its own folder."""
    return record_two(tmp_path_factory.mktemp("recordings"))


@pytest.mark.slow
def test_a_folder_of_recordings_becomes_tables_and_the_option_trim_omits_the_time_before_the_engagement(
    recordings: Sequence[Path], tmp_path: Path
) -> None:
    lengths = []
    for name, options in (("whole", ()), ("trimmed", ("--trim",))):
        out, folder = tmp_path / name, str(recordings[0].parent.parent)
        assert q2r2("export", "csv", folder, "--output", str(out), "--fps", "100", *options).exit_code == 0
        assert set(contents(out)) == {"units.json", *(f"{file.stem}.csv" for file in recordings)}
        with (out / f"{recordings[0].stem}.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert {row["task"] for row in rows} == {"a test"}
        lengths.append(len(rows))
    assert lengths[0] >= DURATION * 100  # The recording goes on after the end of the run, until the arms are at rest.
    assert lengths[0] - lengths[1] >= 10  # The press comes 0.1 s after the beginning.


def test_the_training_config_of_openpi_is_printed_after_the_dataset(recordings: Sequence[Path], tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra export is not installed")
    result = q2r2("export", "lerobot-v2.1", *map(str, recordings), "--output", str(tmp_path / "circle"))
    assert result.stdout.startswith(f"{tmp_path / 'circle'}: 2 of 2 recordings at 30 frames per second\n# openpi: 16 ")
    assert "make_bool_mask(14, -2)" in result.stdout
    assert 'repo_id="q2r2/circle"' in result.stdout
    assert (tmp_path / "circle/data/chunk-000/episode_000001.parquet").exists()


def test_an_hdf5_file_has_the_actions_of_the_next_frame_unless_an_option_changes_this(
    recordings: Sequence[Path], tmp_path: Path
) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra export is not installed")
    actions = {}
    for name, options in (("usual", ()), ("plain", ("--ahead", "0"))):
        out = tmp_path / name
        assert q2r2("export", "hdf5", str(recordings[0]), "--output", str(out), *options).exit_code == 0
        with h5py.File(out / "episode_0.hdf5") as file:
            actions[name, int(file.attrs["action_ahead_frames"])] = file["action"][:]
    assert set(actions) == {("usual", 1), ("plain", 0)}
    assert (actions["usual", 1][:-1] == actions["plain", 0][1:]).all()
    assert (actions["usual", 1] != actions["plain", 0]).any()


def test_a_bad_recording_is_left_out_and_changes_the_exit_code_unless_the_option_skip_bad_is_given(
    recordings: Sequence[Path], tmp_path: Path
) -> None:
    (tmp_path / "notes.mcap").write_text("no recording\n")
    arguments = ("export", "csv", str(tmp_path / "notes.mcap"), str(recordings[1]), "--output")
    for name, options, code in (("out", (), 2), ("skipped", ("--skip-bad",), 0)):
        result = q2r2(*arguments, str(tmp_path / name), *options)
        assert result.exit_code == code
        assert f"{tmp_path / 'notes.mcap'}: discard: unreadable, not an MCAP file" in result.stderr
        assert result.stdout == f"{tmp_path / name}: 1 of 2 recordings at 30 frames per second\n"
        assert set(contents(tmp_path / name)) == {f"{recordings[1].stem}.csv", "units.json"}
    result = q2r2("export", "csv", str(tmp_path / "notes.mcap"), "--output", str(tmp_path / "none"), "--skip-bad")
    assert result.exit_code == 2
    assert "none of the recordings can be exported" in result.stderr


def test_discarded_episodes_are_left_out_unless_an_option_keeps_them(
    recordings: Sequence[Path], tmp_path: Path
) -> None:
    file = rewrite(recordings[0], tmp_path / "lost.mcap", lambda _, one: None if 100 <= one.number < 120 else one)
    arguments = ("export", "csv", str(file), str(recordings[1]), "--output")
    result = q2r2(*arguments, str(tmp_path / "out"), "--fps", "10")
    assert (result.exit_code, set(contents(tmp_path / "out"))) == (0, {f"{recordings[1].stem}.csv", "units.json"})
    assert f"{file}: discard: ticks lost in the recording" in result.stderr
    assert "left out, since q2r2 judge discards them: 1; --keep-discarded exports them too" in result.stderr
    result = q2r2(*arguments, str(tmp_path / "both"), "--fps", "10", "--keep-discarded")
    assert set(contents(tmp_path / "both")) == {f"{recordings[1].stem}.csv", "lost.csv", "units.json"}


def test_an_interrupted_export_leaves_no_incomplete_dataset_and_the_next_export_completes_it(
    recordings: Sequence[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: Any) -> None:
        raise KeyboardInterrupt

    arguments = ("export", "csv", *map(str, recordings), "--output")
    with monkeypatch.context() as patch:
        patch.setitem(FORMATS, "csv", ExportFormat(write_table, interrupted))
        interrupted_export = q2r2(*arguments, str(tmp_path / "out"))
    assert (interrupted_export.exit_code, interrupted_export.stderr) == (130, "q2r2: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["out.partial"]
    for name in ("out", "at_once"):
        assert q2r2(*arguments, str(tmp_path / name)).exit_code == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "at_once")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["at_once", "out"]
