"""Commands on a cluster do the same as in one process, even if one of its two workers is killed in the middle."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.export_format import ExportFormat
from q2r2_control.export.formats import gather_tables, write_table
from q2r2_control.judging.judge import Judgement, Unreadable, judgements_of
from tests.cli.command import q2r2
from tests.demo.test_assembly_tasks import coarse
from tests.export.files import contents, record_step
from tests.support.dask_cluster import DaskCluster, dask_cluster, die_once

pytestmark = pytest.mark.slow


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[DaskCluster]:
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    (folder := tmp_path / "cluster").mkdir()
    with dask_cluster(folder) as found:
        yield found


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with six recordings, and a file that is not a recording."""
    folder = tmp_path_factory.mktemp("recordings")
    file = record_step(folder / "run").file
    first = file.rename(folder / "a0.mcap")
    for number in range(1, 6):
        shutil.copy(first, folder / f"a{number}.mcap")
    (folder / "bad.mcap").write_text("no recording\n")
    return folder


def judge_or_die(settings: JudgeSettings | None, file: Path) -> Sequence[Judgement | Unreadable]:
    """Judge a recording. The third recording ends its worker once."""
    if file.stem == "a2":
        die_once(file.parent)
    return judgements_of(settings, file)


def write_or_die(episode: EpisodeVectors, path: Path) -> None:
    """Write an episode. The third episode ends its worker once, after a part of its file is written."""
    if episode.recording == "a2.mcap":
        path.write_text("a part")
        die_once(path.parents[2])
    write_table(episode, path)


def test_judge_prints_the_same_lines_on_a_cluster_and_in_one_process(
    recordings: Path, cluster: DaskCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = q2r2("judge", str(recordings), "--json")
    monkeypatch.setattr("q2r2_control.cli.recordings.judgements_of", judge_or_die)
    shared = q2r2("judge", str(recordings), "--json", "--cluster", cluster.address)
    assert (recordings / "died").exists()
    assert (shared.exit_code, shared.stdout) == (alone.exit_code, alone.stdout) == (2, alone.stdout)
    assert len(json.loads(alone.stdout)["episodes"]) == 7


def test_export_writes_the_same_files_on_a_cluster_and_in_one_process(
    recordings: Path, cluster: DaskCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "q2r2_control.cli.recordings.format_named", lambda name: ExportFormat(write_or_die, gather_tables)
    )
    arguments = ("export", "csv", str(recordings), "--keep-discarded", "--output")
    shared = q2r2(*arguments, str(tmp_path / "shared"), "--cluster", cluster.address)
    assert (tmp_path / "died").exists()
    alone = q2r2(*arguments, str(tmp_path / "alone"))  # The third episode no longer ends its process.
    assert contents(tmp_path / "shared") == contents(tmp_path / "alone")
    assert len(contents(tmp_path / "alone")) == 6
    assert shared.stdout == alone.stdout.replace("alone", "shared")
    assert [path.name for path in tmp_path.iterdir() if path.name.endswith(".partial")] == []


def test_soaks_and_trials_on_a_cluster_give_the_same_results_as_on_this_computer(
    cluster: DaskCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("q2r2_control.cli.run.load_config", lambda name: coarse())
    for command in (
        ("soak", "--seeds", "3", "--ticks", "300"),
        ("demo", "grasp", "--seeds", "1", "--mode", "position"),
    ):
        alone, shared = (report_of(*command, *options) for options in ((), ("--cluster", cluster.address)))
        assert shared == alone


def report_of(*command: str) -> Any:
    """Return the JSON of a command without the growth of memory, which is measured and differs from run to run."""
    report = json.loads(q2r2(*command, "--json").stdout)
    if isinstance(report, dict):
        del report["memory_growth_mb"]
    return report
