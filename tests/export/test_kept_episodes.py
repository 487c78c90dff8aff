"""The episodes of several recordings are made once, by however many processes."""

from __future__ import annotations

import os
import shutil
from multiprocessing import active_children
from pathlib import Path

import pytest

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import FrameSampling
from q2r2_control.export.kept_episodes import Output, keep_episodes
from tests.export.runs import Run, contents, record_step
from tests.export.vectors import load_vectors, write_vectors

pytestmark = pytest.mark.slow

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # begins the data of a chunk


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_step(tmp_path_factory.mktemp("recordings"))


def test_several_processes_make_the_same_bytes_as_one(run: Run, tmp_path: Path) -> None:
    files = [run.file, Path(shutil.copy(run.file, tmp_path / "copy.mcap"))]
    for workers in (1, 2):
        (tmp_path / str(workers)).mkdir()
        made = keep_episodes(files, FrameSampling(), write_vectors, tmp_path / str(workers), workers=workers)
        assert len(made.kept) == 2
        assert [load_vectors(file).recording for file in made.kept] == [file.name for file in files]
    assert contents(tmp_path / "1") == contents(tmp_path / "2") != {}


def test_an_interrupted_export_goes_on_with_what_it_had(run: Run, tmp_path: Path) -> None:
    files = [run.file, Path(shutil.copy(run.file, tmp_path / "copy.mcap"))]
    kept = tmp_path / "kept"
    kept.mkdir()

    def interrupt(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        keep_episodes(files, FrameSampling(), write_vectors, kept, progress=interrupt)
    (first,) = kept.iterdir()
    made_at = first.stat().st_mtime_ns
    made = keep_episodes(files, FrameSampling(), write_vectors, kept)
    assert made.kept[0] == first
    assert first.stat().st_mtime_ns == made_at
    # An episode that was not finished, and other options, are made anew.
    first.rename(first.with_name(f"{first.name}.unfinished"))
    keep_episodes(files, FrameSampling(), write_vectors, kept)
    assert load_vectors(first).frames == load_vectors(made.kept[1]).frames
    other = keep_episodes(files[:1], FrameSampling(fps=10), write_vectors, kept)
    assert load_vectors(other.kept[0]).fps == 10


def test_a_worker_that_is_killed_is_one_line_and_the_next_export_goes_on(run: Run, tmp_path: Path) -> None:
    files = [run.file, *(Path(shutil.copy(run.file, tmp_path / f"copy-{number}.mcap")) for number in range(2))]
    kept = tmp_path / "kept"
    kept.mkdir()
    *others, last = keep_episodes(files, FrameSampling(), write_vectors, kept).kept
    last.unlink()
    made_at = [other.stat().st_mtime_ns for other in others]
    unfinished = last.with_name(f"{last.name}.unfinished")
    os.mkfifo(unfinished)  # nobody reads it, so a worker is in the middle of its episode for good

    def kill(done: int) -> None:
        if done == len(others):
            for process in active_children():
                process.kill()

    with pytest.raises(ConfigError, match="a process of --workers was killed") as fault:
        keep_episodes(files, FrameSampling(), write_vectors, kept, workers=2, progress=kill)
    assert "\n" not in str(fault.value)
    unfinished.unlink()
    assert keep_episodes(files, FrameSampling(), write_vectors, kept, workers=2).kept == [*others, last]
    assert [other.stat().st_mtime_ns for other in others] == made_at


@pytest.mark.parametrize("workers", [1, 2])
def test_a_bad_recording_is_named_or_skipped(workers: int, run: Run, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(run.file.read_bytes())
    data[data.rindex(ZSTD_MAGIC) + 200] ^= 0xFF
    damaged.write_bytes(data)
    with pytest.raises(RecordingError, match=r"damaged\.mcap: damaged"):
        keep_episodes([damaged, run.file], FrameSampling(), write_vectors, tmp_path, workers=workers)
    made = keep_episodes([damaged, run.file], FrameSampling(), write_vectors, tmp_path, workers=workers, skip_bad=True)
    assert len(made.kept) == 1
    (fault,) = made.skipped
    assert "damaged.mcap: damaged" in fault


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
