"""If the run, the writer or the disk fails, the other parts go on, and the file keeps the earlier data."""

from __future__ import annotations

import json
import logging
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import Recorder
from q2r2_control.recording.replay import replay
from q2r2_control.recording.tick_rows import PackedTick
from q2r2_control.recording.writer import read_ahead
from q2r2_control.teleop.haptics import FAULT
from q2r2_control.types import HapticFeedback
from tests.recording.runs import ROOT, ended_line, pipeline, read_elsewhere, record, writer_of
from tests.support.processes import alive, children, wait_until

pytestmark = pytest.mark.slow

WRITTEN_LATER = 60.0  # Simulated duration of a run [s]. A listener ends the run earlier.


def script(loop: Pipeline, steps: Callable[[Recorder], Iterator[None]]) -> Callable[[Recorder], None]:
    """Return a function for the argument ``during`` of :func:`record`. It plays ``steps`` during the run of ``loop``.

    At each tick, the generator ``steps`` goes on until its next ``yield``. The run ends when the generator returns.
    """

    def begin(recorder: Recorder) -> None:
        left = steps(recorder)
        loop.listeners.append(lambda tick: loop.stop() if next(left, loop) is loop else None)

    return begin


def test_while_the_writer_is_stopped_the_loop_goes_on_and_losses_are_counted(tmp_path: Path) -> None:
    recorders: list[Recorder] = []

    def stopped_for_a_while(recorder: Recorder) -> Iterator[None]:
        recorders.append(recorder)
        for _ in range(20):
            yield
        os.kill(writer_of(recorder).pid, signal.SIGSTOP)
        while recorder.overflows < 100:
            yield
        os.kill(writer_of(recorder).pid, signal.SIGCONT)
        calm = 0
        while calm < 50:
            lost = recorder.overflows
            yield
            calm = calm + 1 if recorder.overflows == lost else 0

    loop = pipeline()
    summary = record(tmp_path, loop, WRITTEN_LATER, waits=False, room=400_000, during=script(loop, stopped_for_a_while))
    assert summary.fault is None
    assert summary.lost_ticks == recorders[0].overflows >= 100
    assert summary.ticks > 100
    file = file_in(tmp_path)
    found = read_elsewhere(file, tmp_path)
    assert found["/q2r2/tick"]["count"] == summary.ticks
    chunks = list(Recording(file).chunks())
    numbers = np.concatenate([chunk.numbers for chunk in chunks])
    with_states = {number for chunk in chunks for number in chunk.states}
    assert {*numbers[1:][np.diff(numbers) > 1].tolist()} <= with_states, "the state is there again behind each gap"
    result = replay(file)
    assert result.difference is None
    assert "ticks were lost here" in str(result.ended_by)
    assert not alive(writer_of(recorders[0]).pid)


@pytest.mark.parametrize("what", ["the process that writes it was ended by SIGKILL", "File too large"])
def test_a_killed_writer_or_a_full_disk_ends_only_the_recording_and_the_written_data_are_kept(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, what: str
) -> None:
    felt: list[HapticFeedback] = []

    def broken(recorder: Recorder) -> Iterator[None]:
        recorder.record_outcome = loop.record_outcome
        while not recorder.written.ticks:
            yield
        if what.endswith("SIGKILL"):
            os.kill(writer_of(recorder).pid, signal.SIGKILL)
        else:
            size = file_in(tmp_path).stat().st_size
            resource.prlimit(writer_of(recorder).pid, resource.RLIMIT_FSIZE, (size + 100, size + 100))
        while not caplog.records:
            yield
        for _ in range(100):
            yield

    loop = pipeline()
    loop.input.send_haptic = felt.append  # type: ignore[method-assign, assignment]
    with caplog.at_level(logging.WARNING):
        summary = record(tmp_path, loop, WRITTEN_LATER, during=script(loop, broken))
    assert ended_line(caplog) == summary.fault == f"{summary.file}: {what}"
    assert {pulse.hand for pulse in felt if (pulse.frequency, pulse.amplitude) == FAULT[:2]} == {"left", "right"}
    assert summary.lost_ticks > 100
    result = replay(file_in(tmp_path))
    assert result.difference is None
    assert result.ticks >= summary.ticks > 0
    if not what.endswith("SIGKILL"):
        assert read_elsewhere(file_in(tmp_path), tmp_path)["/q2r2/tick"]["count"] == summary.ticks


def test_the_writer_reads_sent_data_ahead_so_that_a_killed_run_does_not_lose_them() -> None:
    taken: list[int] = []
    tick = PackedTick(bytes(1000), b"", "")

    def requests() -> Iterator[list[PackedTick]]:
        for number in range(20):
            taken.append(number)
            yield [tick]

    ahead = read_ahead(requests(), room=5000)
    assert next(ahead) == [tick]
    wait_until(lambda: len(taken) >= 6)
    assert len(taken) <= 8, "no more than there is room for"
    assert list(ahead) == 19 * [[tick]]
    assert taken == list(range(20))


def test_a_writer_that_hangs_at_the_end_of_a_run_is_killed_after_a_timeout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("q2r2_control.recording.recorder.PATIENCE", 0.1)
    pids: list[int] = []

    def hang(recorder: Recorder) -> None:
        pids.append(writer_of(recorder).pid)
        os.kill(pids[0], signal.SIGSTOP)

    summary = record(tmp_path, pipeline(), 0.1, during=hang)
    assert str(summary.fault).endswith("-test.mcap: the process that writes it did nothing for 0.1 s")
    assert summary.file is None, "nothing is in it"
    assert not alive(pids[0])


def file_in(folder: Path) -> Path:
    (file,) = folder.glob("*/*.mcap")
    return file


RUN = """
import sys
from pathlib import Path
from q2r2_control.judging.episode_judge import EpisodeJudge
from tests.recording.runs import pipeline, record
loop = pipeline()
EpisodeJudge(lambda: None, print).start()
count = 0
def tell(tick):
    global count
    count += 1
    print(count, flush=True)
record(Path(sys.argv[1]), loop, 600.0, realtime=True, during=lambda recorder: loop.listeners.append(tell))
"""


PATH = {**os.environ, "PYTHONPATH": str(ROOT)}


@contextmanager
def started(*command: str, cwd: Path = ROOT, env: Mapping[str, str] = PATH) -> Iterator[subprocess.Popen[str]]:
    running = subprocess.Popen(
        [sys.executable, *command], cwd=cwd, env=env, process_group=0,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield running
    finally:
        running.kill()
        running.communicate()


def has_ticks(folder: Path) -> bool:
    """Return whether a recording in this folder already contains ticks."""
    try:
        return any(len(chunk.rows) for file in folder.glob("*/*.mcap") for chunk in Recording(file).chunks())
    except RecordingError:
        return False


@pytest.mark.parametrize("both", [False, True], ids=["the run alone", "the writer too"])
def test_the_file_of_a_killed_run_can_be_opened_and_replayed(tmp_path: Path, both: bool) -> None:
    with started("-c", RUN, str(tmp_path)) as running:
        assert running.stdout is not None
        while int(running.stdout.readline()) < 100:
            pass
        wait_until(lambda: has_ticks(tmp_path))
        helpers = children(running.pid)
        assert len(helpers) == 2
        if both:  # The writer is killed first. Otherwise it would notice the run's end, and close the file.
            for helper in helpers:
                os.kill(helper, signal.SIGKILL)
        running.kill()
        running.wait()
        wait_until(lambda: not any(map(alive, helpers)))
    file = file_in(tmp_path)
    assert Recording(file).closed is not both
    result = replay(file)
    assert result.difference is None
    assert result.ticks > 0
    assert "its process was killed" in str(result.ended_by)
    if not both:
        found = read_elsewhere(file.parent, tmp_path)
        assert set(found) >= {"/joint_states", "/robot_description", "/q2r2/state"}
        assert found["/q2r2/tick"]["count"] == result.ticks


COMMAND = f"""
import sys
sys.path.insert(1, {str(ROOT)!r})
from q2r2_control.cli.app import app
app()
"""


def test_ctrl_c_ends_a_run_in_another_folder_and_the_recording_is_complete(tmp_path: Path) -> None:
    cell = str(ROOT / "config/dual_iiwa7.yaml")
    options = ("run", cell, "--plant", "kinematic", "--headless", "--json", "--record", str(tmp_path / "recordings"))
    script, folder = tmp_path / "bin" / "q2r2", tmp_path / "folder"
    for trap in ("q2r2_control", "json"):
        (folder / trap).mkdir(parents=True)
        (folder / trap / "__init__.py").write_text("raise ImportError('not this one')")
    script.parent.mkdir()
    script.write_text(COMMAND)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with started(str(script), *options, cwd=folder, env=environment) as running:
        recordings = tmp_path / "recordings"
        wait_until(lambda: has_ticks(recordings))
        (writer,) = children(running.pid)
        os.kill(writer, signal.SIGINT)
        os.kill(writer, signal.SIGTERM)
        os.killpg(running.pid, signal.SIGINT)
        stdout, stderr = running.communicate()
    assert running.returncode == 0, stderr
    summary = json.loads(stdout)
    assert summary["recording"]["fault"] is None
    assert summary["recording"]["ticks"] == summary["ticks"]
    assert not alive(writer)
    assert replay(Path(summary["recording"]["file"])).ended_by is None
