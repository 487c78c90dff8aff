"""Recording never disturbs a run, loses nothing silently, and leaves files that other programs can open."""

from __future__ import annotations

import json
import logging
import math
import os
import re
import resource
import signal
import time
import tracemalloc
from dataclasses import replace as changed
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import yaml

from q2r2_control.config.cell_file import parse_config
from q2r2_control.config.recording import TOPIC_RATE
from q2r2_control.errors import RecordingError
from q2r2_control.recording.about import ABOUT, About
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import STATE, TEXT, Message, Topic, run_topics, text
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import Recorder, is_empty
from q2r2_control.recording.replay import replay
from q2r2_control.recording.tick_rows import PackedTick, TickPacker
from q2r2_control.summary.tick import Tick
from tests.recording.runs import ARMS, JOINTS, RATE, ended_line, file_of, pipeline, read_elsewhere, record, writer_of
from tests.support.processes import wait_until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Tick]]:
    ticks: list[Tick] = []
    loop = pipeline("circle", "mujoco")
    loop.listeners.append(ticks.append)
    return file_of(record(tmp_path_factory.mktemp("recordings"), loop, 2.0)), ticks


def test_rosbags_in_another_process_reads_every_topic_with_the_data_of_the_run(
    tmp_path: Path, recorded: tuple[Path, list[Tick]]
) -> None:
    file, ticks = recorded
    found = read_elsewhere(file.parent, tmp_path)
    assert {name: entry["type"] for name, entry in found.items()} == {
        name: topic.type for name, topic in run_topics(ARMS, JOINTS).items()
    }
    assert found["/q2r2/tick"]["count"] == len(ticks)
    shown = first_of_each_period(ticks, TOPIC_RATE)
    assert len(shown) == pytest.approx(len(ticks) * TOPIC_RATE / RATE, abs=1)
    for name in ("/joint_states", "/q2r2/external_torque", "/joint_commands", "/q2r2/reference"):
        assert found[name]["count"] == len(shown)
    samples = [sample for tick in ticks for sample in tick.samples]
    assert found["/q2r2/hand_samples"]["count"] == len(samples)
    assert found["/q2r_left_hand_pose"]["count"] == sum(sample.hand == "left" for sample in samples)
    led = [tick for tick in ticks if tick.targets["left"].pose is not None]
    with_target = sum(tick.targets["left"].pose is not None for tick in shown)
    assert found["/q2r2/left/target_frame"]["count"] == with_target > 50
    commands = found["/joint_commands"]
    assert commands["position"] == shown[-1].command.q.tolist()
    assert commands["last"] - commands["first"] == pytest.approx(1e9 * (shown[-1].t - shown[0].t), abs=1000)
    states = [json.loads(text) for text in found["/q2r2/state"]["texts"]]
    assert [event["kind"] for state in states for event in state.get("events", ())] == ["pressed", "pressed"]
    arms = np.concatenate([chunk.rows["arms"] for chunk in Recording(file).chunks()])[:, 0]
    asked = arms["target"].any(axis=1)
    poses, targets = arms["filtered_hand"][asked, :3], arms["target"][asked, :3]
    hands = [tick.targets["left"].hand for tick in led]
    np.testing.assert_array_equal(poses, [hand.translation for hand in hands if hand is not None])
    # With the stance ``side_by_side`` and scale 1, the target moves from its first position exactly as the hand does.
    assert np.ptp(poses, axis=0).max() > 0.005
    np.testing.assert_allclose(targets - targets[0], poses - poses[0], atol=1e-9)


def first_of_each_period(ticks: list[Tick], rate: float) -> list[Tick]:
    periods = [math.floor((tick.now - tick.start.now) * rate + 1e-6) for tick in ticks]
    return [tick for tick, now, before in zip(ticks, periods, [-1, *periods], strict=False) if now > before]


def test_without_a_topic_rate_every_tick_writes_the_standard_topics(tmp_path: Path) -> None:
    loop = pipeline()
    with Recorder(tmp_path, "test", waits=True) as recorder:
        recorder.begin(About.of(loop, False, {}), loop.robot, None)
        loop.listeners.append(recorder)
        loop.run(0.2, realtime=False)
    assert recorder.summary.file is not None
    counts = Recording(Path(recorder.summary.file)).counts
    assert counts is not None
    assert counts["/joint_states"] == counts["/q2r2/tick"] == recorder.summary.ticks


def test_a_clock_that_is_set_back_during_a_run_changes_no_time_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Each call returns a Unix time that is an hour before the time of the last call.
    hours = count(1_700_000_000_000_000_000, -3_600_000_000_000)
    monkeypatch.setattr(time, "time_ns", lambda: next(hours))
    file = file_of(record(tmp_path, pipeline(), 0.5))
    times = np.concatenate([chunk.times * 1e-9 for chunk in Recording(file).chunks()])
    np.testing.assert_allclose(np.diff(times), 1.0 / RATE, atol=1e-6)


def test_the_folder_of_a_recording_is_a_rosbag_of_version_nine_that_describes_the_run(
    recorded: tuple[Path, list[Tick]],
) -> None:
    file, ticks = recorded
    bag = yaml.safe_load((file.parent / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (bag["version"], bag["storage_identifier"]) == (9, "mcap")
    assert bag["relative_file_paths"] == [file.name]
    counts = {entry["topic_metadata"]["name"]: entry["message_count"] for entry in bag["topics_with_message_count"]}
    assert counts["/q2r2/tick"] == len(ticks)
    assert sum(counts.values()) == bag["message_count"] == bag["files"][0]["message_count"]
    hashes = {entry["topic_metadata"]["type_description_hash"][:7] for entry in bag["topics_with_message_count"]}
    assert hashes == {"RIHS01_"}
    about, loop = Recording(file).about, pipeline("circle", "mujoco")
    assert parse_config(about.cell, "recorded") == loop.config
    assert (about.robot, about.realtime, about.notes["task"]) == (loop.robot.urdf, False, "a test")
    assert {"version", "machine", "libraries", "plant"} <= about.notes.keys() & bag["custom_data"].keys()


def test_for_a_folder_that_cannot_be_written_one_line_is_logged_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "file"
    file.write_text("in the way")
    with caplog.at_level(logging.WARNING):
        summary = record(file, pipeline(), 0.2)
    assert ended_line(caplog).startswith(f"--record {file}")
    assert summary.fault is not None
    assert (summary.file, summary.ticks) == (None, 0)
    assert summary.lost_ticks >= 0.2 * RATE


def test_a_recorder_that_wrote_nothing_leaves_no_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def fill_the_disk(recorder: Recorder) -> None:
        resource.prlimit(writer_of(recorder).pid, resource.RLIMIT_FSIZE, (1000, 1000))

    loop = pipeline()
    with Recorder(tmp_path / "full", "test", waits=True) as recorder:
        fill_the_disk(recorder)
        recorder.begin(About.of(loop, False, {}), loop.robot)
        loop.listeners.append(recorder)
        loop.run(0.3, realtime=False)
    assert "File too large" in str(recorder.summary.fault)
    assert recorder.summary.file is None
    assert list((tmp_path / "full").iterdir()) == []


def test_if_the_writer_fails_before_its_first_complete_message_its_file_and_folder_are_removed(tmp_path: Path) -> None:
    loop = pipeline()
    about, topic = About.of(loop, False, {}), Topic(1, STATE, TEXT)
    folder = tmp_path / "run"
    folder.mkdir()

    def write_and_fail() -> None:
        with BagWriter(folder / "run.mcap", [topic], about) as bag:
            bag.write([Message(1, 0, about.epoch, 0, text("not flushed"))])
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        write_and_fail()
    assert not folder.exists()


def test_a_file_with_messages_does_not_count_as_empty_even_if_the_data_before_them_are_damaged(tmp_path: Path) -> None:
    file = file_of(record(tmp_path, pipeline(), 0.2))
    whole = file.read_bytes()
    assert not is_empty(file)
    file.write_bytes(whole.replace(ABOUT.encode(), b"?" * len(ABOUT))[:-100])
    with pytest.raises(RecordingError):
        Recording(file)
    assert not is_empty(file)


@pytest.mark.parametrize("least", [0, 5000], ids=["nothing yet", "some of its header"])
def test_a_file_whose_writer_was_killed_before_the_first_message_is_removed(tmp_path: Path, least: int) -> None:
    def kill(recorder: Recorder) -> None:
        wait_until(lambda: any(file.stat().st_size >= least for file in tmp_path.rglob("*.mcap")))
        os.kill(writer_of(recorder).pid, signal.SIGKILL)

    summary = record(tmp_path, pipeline(), 0.3, during=kill)
    assert summary.fault is not None
    assert summary.file is None
    assert list(tmp_path.iterdir()) == []


def test_a_writer_that_falls_behind_the_run_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    loop = pipeline()
    with caplog.at_level(logging.WARNING), Recorder(tmp_path, "slow") as recorder:
        recorder.begin(About.of(loop, False, {}), loop.robot)
        os.kill(writer_of(recorder).pid, signal.SIGSTOP)
        loop.listeners.append(recorder)
        loop.run(3.0, realtime=False)
        os.kill(writer_of(recorder).pid, signal.SIGCONT)
    (line,) = caplog.messages
    assert re.match(r"the recording is 2\.0 s behind the run: its writer gets too little of the processors", line)
    assert recorder.summary.longest_backlog_s > 2.5
    assert recorder.summary.lost_ticks == 0


def test_runs_that_begin_within_one_second_get_separate_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: 1_700_000_000_000_000_000)
    files = [file_of(record(tmp_path, pipeline(), 0.2)) for _ in range(2)]
    assert len({file.parent for file in files}) == len(list(tmp_path.iterdir())) == 2
    for file in files:
        assert replay(file).difference is None


@pytest.mark.parametrize("side", ["the loop's", "the writer's"])
def test_an_internal_error_of_the_recorder_does_not_end_the_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, side: str
) -> None:
    def spoil(recorder: Recorder) -> None:
        if side == "the writer's":
            writer_of(recorder).send([PackedTick(b"no tick", b"", "")])
        else:
            recorder._packer = TickPacker(("third",), ())

    with caplog.at_level(logging.WARNING):
        summary = record(tmp_path, pipeline(), 0.3, during=spoil)
    assert summary.fault is not None
    assert ("buffer size" if side == "the writer's" else "third") in summary.fault
    assert summary.ticks == 0
    assert summary.lost_ticks >= 0.3 * RATE
    assert ended_line(caplog) == summary.fault


def test_the_recorder_needs_no_more_memory_in_a_longer_run(tmp_path: Path, recorded: tuple[Path, list[Tick]]) -> None:
    loop, tick = pipeline("circle", "mujoco"), recorded[1][200]
    held: list[tuple[int, int]] = []
    with Recorder(tmp_path, "long", waits=True) as recorder:
        status = Path(f"/proc/{writer_of(recorder).pid}/status")
        recorder.begin(About.of(loop, False, {}), loop.robot)
        tracemalloc.start()
        for number in range(16000):
            recorder(changed(tick, now=tick.start.now + 1e-3 * number))
            if number % 4000 == 3999:
                (resident,) = re.findall(r"VmRSS:\s*(\d+) kB", status.read_text())
                held.append((tracemalloc.get_traced_memory()[0], 1024 * int(resident)))
        tracemalloc.stop()
    assert recorder.summary.lost_ticks == 0
    for now, then in zip(held[-1], held[0], strict=True):
        # At most 8 MB of ticks wait for the writer. The ticks between the first and the last measurement have 18 MB.
        assert now - then < 14e6
