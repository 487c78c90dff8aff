"""A Ray cluster makes the same episodes, also when one of its workers is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from q2r2_control.export.csv_tables import write_vectors
from q2r2_control.export.episodes import FrameSampling
from q2r2_control.export.kept_episodes import keep_episodes
from tests.export.runs import contents, record_two

pytestmark = pytest.mark.slow

ray = pytest.importorskip("ray", reason="the extra ray is not installed")

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import sys
from pathlib import Path
from q2r2_control.errors import Q2R2Error
from q2r2_control.export.csv_tables import write_vectors
from q2r2_control.export.episodes import FrameSampling
from q2r2_control.export.kept_episodes import keep_episodes
address, folder, *files = sys.argv[1:]
try:
    keep_episodes([Path(file) for file in files], FrameSampling(), write_vectors, Path(folder), ray=address)
except Q2R2Error as error:
    sys.exit(str(error))
"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Of a cluster of two workers on this machine, which ends with the test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]))
        ray.init(
            num_cpus=2,
            _node_ip_address="127.0.0.1",
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
        )
    yield ray.get_runtime_context().gcs_address
    ray.shutdown()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of two runs."""
    return list(record_two(tmp_path_factory.mktemp("recordings")))


def export(recordings: list[Path], folder: Path, address: str) -> subprocess.Popen[str]:
    folder.mkdir()
    command = [sys.executable, "-c", PROGRAM, address, str(folder), *map(str, recordings)]
    return subprocess.Popen(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def worker() -> int | None:
    """A process of the cluster that makes an episode now."""
    for folder in Path("/proc").iterdir():
        with suppress(OSError):
            if folder.name.isdigit() and (folder / "cmdline").read_bytes().startswith(b"ray::_keep"):
                return int(folder.name)
    return None


def test_the_episodes_are_the_same_when_a_worker_is_killed_in_the_middle(
    recordings: list[Path], address: str, tmp_path: Path
) -> None:
    (tmp_path / "here").mkdir()
    keep_episodes(recordings, FrameSampling(), write_vectors, tmp_path / "here")
    process = export(recordings, tmp_path / "there", address)
    killed = None
    while killed is None and process.poll() is None:
        killed = worker()
        time.sleep(0.01)
    assert killed is not None
    os.kill(killed, signal.SIGKILL)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert contents(tmp_path / "there") == contents(tmp_path / "here")


def test_a_bad_recording_and_a_cluster_that_is_not_there_are_one_line(
    recordings: list[Path], address: str, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")
    for files, to, line in (
        ([*recordings, bad], address, f"{bad}: not an MCAP file"),
        (recordings, "127.0.0.1:1", "--ray 127.0.0.1:1: Connection refused; allowed: a running cluster, "),
    ):
        _, errors = export(files, tmp_path / to, to).communicate(timeout=300)
        assert errors.startswith(line)
        assert len(errors.splitlines()) == 1
