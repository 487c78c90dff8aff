"""``q2r2 export lerobot`` as a user types it; any number of processes and a Ray cluster make the same."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")

from q2r2_control.recording.files import recordings_in
from tests.cli.command import q2r2
from tests.export.runs import contents, record_two

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two runs."""
    folder = tmp_path_factory.mktemp("recordings")
    record_two(folder)
    return folder


def export(recordings: Path, out: Path, *options: str) -> dict[str, bytes]:
    """Export and return the files that are made."""
    result = q2r2("export", "lerobot", str(recordings), "--output", str(out), *options)
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == f"{out}: 2 of 2 recordings at 30 frames per second\n"
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    return contents(out)


def same(found: dict[str, bytes], expected: dict[str, bytes]) -> bool:
    """Whether files are the same to the byte, but for the order in which lerobot names features in its statistics."""
    name = "meta/stats.json"
    others = [{path: data for path, data in files.items() if path != name} for files in (found, expected)]
    return json.loads(found[name]) == json.loads(expected[name]) and others[0] == others[1]


@pytest.fixture(scope="module")
def made(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a dataset that one process made."""
    return export(recordings, tmp_path_factory.mktemp("one") / "out")


def test_a_dataset_has_the_features_that_the_docs_name(made: dict[str, bytes]) -> None:
    info = json.loads(made["meta/info.json"])
    names = [line.split("|")[1] for line in (ROOT / "docs/recording.md").read_text().splitlines() if "| `" in line]
    documented = {name for cell in names for name in cell.replace("`", " ").replace(",", " ").split()}
    assert set(info["features"]) <= documented
    assert info["robot_type"] == "dual_iiwa7"


def test_several_processes_make_the_same_bytes(recordings: Path, made: dict[str, bytes], tmp_path: Path) -> None:
    assert same(export(recordings, tmp_path / "out", "--workers", "2"), made)


def test_a_ray_cluster_makes_the_same_bytes(recordings: Path, made: dict[str, bytes], tmp_path: Path) -> None:
    ray = pytest.importorskip("ray", reason="the extra ray is not installed")
    path = os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    ray.init(
        num_cpus=1,
        _node_ip_address="127.0.0.1",
        include_dashboard=False,
        log_to_driver=False,
        logging_level="ERROR",
        runtime_env={"env_vars": {"PYTHONPATH": path}},
    )
    try:
        address = ray.get_runtime_context().gcs_address
        command = [sys.executable, "-m", "q2r2_control", "export", "lerobot", str(recordings), "--ray", address]
        subprocess.run([*command, "--output", str(tmp_path / "out")], cwd=ROOT, check=True, timeout=600)
    finally:
        ray.shutdown()
    assert same(contents(tmp_path / "out"), made)


def test_nothing_is_written_of_a_recording_that_is_none(recordings: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"no recording")
    files = map(str, [*recordings_in([recordings]), tmp_path / "bad.mcap"])
    result = q2r2("export", "lerobot", *files, "--output", str(tmp_path / "out"))
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert not (tmp_path / "out").exists()
