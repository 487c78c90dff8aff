"""Recordings are judged from the command line, as a user does it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader

from q2r2_control.cli.recordings import verdict_table
from q2r2_control.judging.judge import judge
from q2r2_control.recording.reader import Recording
from tests.cli.command import FAST, changed_cell, one_object, q2r2
from tests.cli.test_output import printed
from tests.judging.episodes import hands, record_episode

IDLE = "max_idle_share: 0.5 "


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a recording that is kept, and a recording that ends before anything moves."""
    folder = tmp_path_factory.mktemp("recordings")
    for name, duration in (("a", 2.0), ("b", 0.5)):
        file = record_episode(folder / name, hands(2), duration)
        file.rename(file.with_name(f"{name}.mcap"))
    return folder


@pytest.mark.slow
def test_judge_prints_a_row_for_each_episode_and_the_reasons_for_a_discarded_episode(recordings: Path) -> None:
    result = q2r2("judge", str(recordings))
    assert (result.exit_code, result.stderr) == (0, "")
    assert "episodes: 1 kept, 1 discarded" in result.stdout
    kept, discarded = sorted(recordings.rglob("*.mcap"))
    lines = [line.split() for line in result.stdout.splitlines()]
    assert [line[1] for line in lines if line and line[0] in (kept.stem, discarded.stem)] == ["keep", "discard"]
    (judged,) = judge(Recording(discarded))
    assert result.stdout.splitlines()[-1] == f"{discarded}: {judged.verdict.line}"


def test_the_json_of_judge_has_every_figure_and_every_reason(recordings: Path, tmp_path: Path) -> None:
    episodes = one_object(q2r2("judge", str(recordings), "--json").stdout)["episodes"]
    assert [episode["verdict"] for episode in episodes] == ["keep", "discard"]
    assert [reason["name"] for reason in episodes[1]["reasons"]] == ["max_idle_share"]
    figures = episodes[0]["figures"]
    assert figures["task"] == "a test"
    assert figures["arms"]["left"]["position_error_mm_rms"] < 5.0
    assert figures["hands"]["right"]["pose_rate_hz"] > 60.0
    assert figures["timing"]["ended"] is True
    lenient = changed_cell(tmp_path, IDLE, "max_idle_share: null ")
    episodes = one_object(q2r2("judge", str(recordings), "--config", lenient, "--json").stdout)["episodes"]
    assert [episode["verdict"] for episode in episodes] == ["keep", "keep"]


def test_the_table_contains_complete_names_of_recordings_in_80_columns(recordings: Path) -> None:
    judged = [one for file in sorted(recordings.rglob("*.mcap")) for one in judge(Recording(file))]
    name = "20261130-132353-demo"
    named = [replace(one, figures=replace(one.figures, file=f"{name}.mcap")) for one in judged]
    assert all(one.figures.name == name for one in named)
    text = printed(verdict_table(named, []))
    assert text.count(name) == 2
    assert max(map(len, text.splitlines())) <= 80
    assert "success" not in text, "a figure that no episode has takes no room"


@pytest.mark.slow
def test_a_report_is_one_page_about_all_recordings(recordings: Path, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    result = q2r2("report", str(recordings), "--output", str(page))
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == f"{page}: 2 episodes, 1 kept, 1 discarded\n"
    assert page.read_text().count("<section ") == 2
    for output in (tmp_path, tmp_path / "missing" / "report.html"):
        refused = q2r2("report", str(recordings), "--output", str(output))
        assert refused.exit_code == 2
        assert f"--output {output}: " in refused.stderr
        assert "allowed: a file in a folder that exists" in refused.stderr


def test_a_page_that_cannot_be_written_is_refused_before_recordings_are_read(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for output, why in ((tmp_path / "file" / "a.html", "Not a directory"), (tmp_path, "Is a directory")):
        refused = q2r2("report", str(tmp_path / "no recordings"), "--output", str(output))
        assert (refused.exit_code, refused.stderr.count("\n")) == (2, 1)
        assert f"--output {output}: {why}; allowed: a file in a folder" in refused.stderr
    missing = q2r2("report", str(tmp_path / "no recordings"), "--output", str(tmp_path / "new.html"))
    assert "no recordings" in missing.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["file"], "the check leaves nothing behind"


def test_a_file_that_cannot_be_read_is_discarded_and_the_other_files_are_judged(
    recordings: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty.mcap").touch()
    why = f"{tmp_path / 'empty.mcap'}: discard: unreadable, "
    result = q2r2("judge", str(tmp_path), str(recordings))
    assert result.exit_code == 2
    assert "episodes: 1 kept, 2 discarded" in result.stdout
    assert result.stdout.splitlines()[-1].startswith(why)
    episodes = one_object(q2r2("judge", str(tmp_path), str(recordings), "--json").stdout)["episodes"]
    assert [episode["verdict"] for episode in episodes] == ["discard", "keep", "discard"]
    assert [reason["name"] for reason in episodes[0]["reasons"]] == ["unreadable"]
    page = tmp_path / "report.html"
    result = q2r2("report", str(tmp_path), str(recordings), "--output", str(page))
    assert (result.exit_code, result.stdout) == (2, f"{page}: 3 episodes, 1 kept, 2 discarded\n")
    assert why in result.stderr
    assert page.read_text().count("<section ") == 2
    assert "discard: unreadable, " in page.read_text()


@pytest.mark.slow
class TestARunThatIsRecorded:
    OPTIONS = ("--trajectory", "line", "--human", "--seed", "5", "--duration", "3")

    def test_the_verdict_is_in_the_summary_of_the_run_and_in_a_file_beside_the_recording(self, tmp_path: Path) -> None:
        result = q2r2(*FAST, *self.OPTIONS, "--record", str(tmp_path))
        assert result.exit_code == 0
        (episode,) = one_object(result.stdout)["judge"]
        assert episode["verdict"] == "keep"
        (kept,) = tmp_path.rglob("verdict.json")
        written = json.loads(kept.read_text())
        assert written["episodes"] == [episode]
        again = one_object(q2r2("judge", str(tmp_path), "--json").stdout)["episodes"]
        assert again == [episode]
        # Other programs can still read the recording, although the verdict is in the same folder.
        with AnyReader([kept.parent]) as bag:
            assert bag.message_count > 0

    def test_the_verdict_is_printed_as_one_line_before_the_figures(self, tmp_path: Path) -> None:
        options = [option for option in (*FAST, *self.OPTIONS) if option != "--json"]
        cell = changed_cell(tmp_path, IDLE, "max_idle_share: 0.01 ")
        result = q2r2(options[0], cell, *options[2:], "--record", str(tmp_path / "here"))
        assert result.exit_code == 0
        _, recording, verdict, *_ = result.stdout.splitlines()
        assert recording.startswith("recording: ")
        (judged,) = judge(Recording(tmp_path / "here"))
        assert [reason.name for reason in judged.verdict.reasons] == ["max_idle_share"]
        assert verdict == f"verdict: {judged.verdict.line}"

    def test_a_verdict_that_cannot_be_written_does_not_change_the_exit_code(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("q2r2_control.judging.judge.VERDICT_FILE", "x" * 300)
        result = q2r2(*FAST, "--duration", "0.3", "--record", str(tmp_path))
        assert result.exit_code == 0
        assert "judge" not in one_object(result.stdout)
        assert "not judged: " in result.stderr
        assert "File name too long" in result.stderr
