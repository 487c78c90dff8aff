"""Recording never stands in the way of a run, loses nothing silently, and leaves files that other programs open."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import textwrap
import time
import tracemalloc
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

import pytest
import yaml

from q2r2_control.config.cell import parse_config
from q2r2_control.recording.about import About
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import Recorder
from q2r2_control.recording.replay import replay
from q2r2_control.recording.topics import Topics
from q2r2_control.runtime.recorder import Tick
from tests.recording.runs import RATE, file_of, pipeline, record

ROOT = Path(__file__).resolve().parents[2]

# Reads a bag with rosbags alone, in a process that has nothing of this package.
READER = """
import json, sys
from pathlib import Path
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
assert not any(name.startswith("q2r2") for name in sys.modules)
found = {}
with AnyReader([Path(sys.argv[1])], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
    for connection, stamp, data in reader.messages():
        message = reader.deserialize(data, connection.msgtype)
        entry = found.setdefault(connection.topic, {"type": connection.msgtype, "count": 0, "first": stamp})
        entry["count"] += 1
        assert stamp >= entry.get("last", 0)
        entry["last"] = stamp
        if connection.topic == "/joint_commands":
            entry["names"], entry["position"] = message.name, message.position.tolist()
        if connection.topic == "/q2r2/state":
            entry.setdefault("texts", []).append(message.data)
print(json.dumps(found))
"""


def read_elsewhere(path: Path, folder: Path) -> dict[str, Any]:
    result = subprocess.run(
        [sys.executable, "-c", READER, str(path)], cwd=folder, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Tick]]:
    """A run in MuJoCo, and its ticks."""
    ticks: list[Tick] = []
    loop = pipeline("circle", "mujoco")
    loop.listeners.append(ticks.append)
    return file_of(record(tmp_path_factory.mktemp("recordings"), loop, 1.0)), ticks


def test_every_topic_opens_with_rosbags_in_another_process(tmp_path: Path, recorded: tuple[Path, list[Tick]]) -> None:
    file, ticks = recorded
    found = read_elsewhere(file.parent, tmp_path)
    topics = Topics(("left", "right"), ())
    assert {name: entry["type"] for name, entry in found.items()} == {topic.name: topic.type for topic in topics.all}
    every = len(ticks)
    for name in ("/q2r2/tick", "/joint_states", "/q2r2/external_torque", "/joint_commands", "/q2r2/flags"):
        assert found[name]["count"] == every
    samples = [sample for tick in ticks for sample in tick.samples]
    assert found["/q2r2/hand_samples"]["count"] == len(samples)
    assert found["/q2r_left_hand_pose"]["count"] == sum(sample.hand == "left" for sample in samples)
    led = [tick for tick in ticks if tick.targets["left"].pose is not None]
    assert found["/q2r2/left/target_frame"]["count"] == len(led) > 50
    commands = found["/joint_commands"]
    assert commands["position"] == ticks[-1].command.q.tolist()
    assert commands["last"] - commands["first"] == pytest.approx(1e9 * (ticks[-1].t - ticks[0].t), abs=1000)
    states = [json.loads(text) for text in found["/q2r2/state"]["texts"]]
    events = [event for state in states for event in state.get("events", ())]
    assert [event["reason"] for event in events] == ["lower button", "lower button"]


def test_the_folder_is_a_bag_of_version_nine(recorded: tuple[Path, list[Tick]]) -> None:
    file, ticks = recorded
    bag = yaml.safe_load((file.parent / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (bag["version"], bag["storage_identifier"]) == (9, "mcap")
    assert bag["relative_file_paths"] == [file.name]
    counts = {entry["topic_metadata"]["name"]: entry["message_count"] for entry in bag["topics_with_message_count"]}
    assert counts["/q2r2/tick"] == len(ticks)
    assert sum(counts.values()) == bag["message_count"] == bag["files"][0]["message_count"]
    hashes = {entry["topic_metadata"]["type_description_hash"][:7] for entry in bag["topics_with_message_count"]}
    assert hashes == {"RIHS01_"}


def test_the_file_says_what_was_run(recorded: tuple[Path, list[Tick]]) -> None:
    about = Recording(recorded[0]).about
    loop = pipeline("circle", "mujoco")
    assert parse_config(about.cell, "recorded") == loop.config
    assert about.robot == loop.robot.urdf
    assert about.notes["task"] == "a test"
    assert {"version", "machine", "libraries", "plant"} <= about.notes.keys()
    assert not about.realtime


def test_a_full_queue_loses_ticks_and_says_how_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flush, slow = McapFile.flush, [True]

    def flush_slowly(file: McapFile) -> None:
        while slow[0]:
            time.sleep(1e-3)
        flush(file)

    monkeypatch.setattr(McapFile, "flush", flush_slowly)
    loop = pipeline()

    def until_some_were_lost(tick: Tick) -> None:
        slow[0] = tick.t < 0.9

    loop.listeners.append(until_some_were_lost)
    monkeypatch.setattr("q2r2_control.recording.recorder._CHUNK_SIZE", 1)
    summary = record(tmp_path, loop, 1.0, capacity=100, waits=False)
    assert summary.fault is None
    assert summary.lost_ticks > 100
    assert summary.ticks > 0
    assert summary.ticks + summary.lost_ticks >= 1.0 * RATE
    assert summary.file is not None
    result = replay(Path(summary.file))
    assert result.difference is None
    assert result.ended_by is not None
    assert "ticks were lost here" in result.ended_by


def test_a_folder_that_cannot_be_written_is_one_line_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "file"
    file.write_text("in the way")
    with caplog.at_level(logging.WARNING):
        summary = record(file, pipeline(), 0.2)
    (line,) = [entry.getMessage() for entry in caplog.records]
    assert line.startswith(f"recording ended, the run goes on: --record {file}")
    assert summary.fault is not None
    assert summary.file is None
    assert summary.ticks == 0
    assert summary.lost_ticks >= 0.2 * RATE


FULL_DISK = """
import resource, sys
from pathlib import Path
from q2r2_control.recording import recorder
from tests.recording.runs import pipeline, record
recorder._CHUNK_TIME = 0.02
resource.setrlimit(resource.RLIMIT_FSIZE, (110_000, 110_000))
summary = record(Path(sys.argv[1]), pipeline(), 1.0)
print(summary.fault, summary.ticks, summary.lost_ticks, summary.file, sep="\\n")
"""


def run_program(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program), *arguments],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def test_a_full_disk_ends_the_recording_and_not_the_run_and_leaves_what_fits(tmp_path: Path) -> None:
    result = run_program(FULL_DISK, str(tmp_path))
    assert result.returncode == 0, result.stderr
    fault, written, lost, file = result.stdout.split("\n")[:4]
    assert fault.endswith("File too large")
    assert int(written) > 0
    assert int(written) + int(lost) >= 1.0 * RATE
    found = read_elsewhere(Path(file), tmp_path)
    assert found["/q2r2/tick"]["count"] == int(written)


KILLED = """
import sys, time
from pathlib import Path
from tests.recording.runs import pipeline, record
loop = pipeline()
loop.listeners.append(lambda tick: print(tick.t, flush=True))
record(Path(sys.argv[1]), loop, 30.0, realtime=True)
"""


def test_what_a_killed_process_leaves_opens_and_misses_a_second_at_most(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    reached = 0.0
    for line in process.stdout:
        reached = float(line)
        if reached > 2.5:
            break
    process.send_signal(signal.SIGKILL)
    rest = process.stdout.read().split("\n")
    reached = max([reached, *(float(line) for line in rest[:-1] if line)])
    process.wait()
    (file,) = tmp_path.glob("*/*.mcap")
    found = read_elsewhere(file.parent, tmp_path)["/q2r2/tick"]
    recorded_time = 1e-9 * (found["last"] - found["first"])
    assert reached - 1.0 < recorded_time <= reached
    assert set(read_elsewhere(file, tmp_path)) >= {"/joint_states", "/robot_description", "/q2r2/left/target_frame"}
    result = replay(file)
    assert result.difference is None
    assert result.ticks == found["count"]
    assert result.ended_by is not None
    assert "its process was killed" in result.ended_by


def test_two_processes_that_record_at_once_get_a_folder_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = """
        import sys, time
        time.time_ns = lambda: 1_700_000_000_000_000_000
        from pathlib import Path
        from tests.recording.runs import pipeline, record
        print(record(Path(sys.argv[1]), pipeline(), 0.2).file)
    """
    monkeypatch.setattr(time, "time_ns", lambda: 1_700_000_000_000_000_000)
    files = [file_of(record(tmp_path, pipeline(), 0.2)) for _ in range(2)]
    result = run_program(program, str(tmp_path))
    assert result.returncode == 0, result.stderr
    files.append(Path(result.stdout.strip()))
    assert len({file.parent for file in files}) == len(list(tmp_path.iterdir())) == 3
    for file in files:
        assert replay(file).difference is None


def test_a_recorder_that_fails_inside_does_not_end_the_run(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def spoil(recorder: Recorder) -> None:
        def fail(batch: object) -> None:
            raise ZeroDivisionError("in the encoder")

        recorder._encoder.encode = fail  # type: ignore[assignment, method-assign]

    with caplog.at_level(logging.WARNING):
        summary = record(tmp_path, pipeline(), 0.3, during=spoil)
    assert summary.fault is not None
    assert "in the encoder" in summary.fault
    assert len(caplog.records) == 1


def test_memory_is_flat_however_long_a_run_is(tmp_path: Path, recorded: tuple[Path, list[Tick]]) -> None:
    loop = pipeline("circle", "mujoco")
    (tick,) = recorded[1][200:201]
    recorder = Recorder(tmp_path, "long", About.of(loop, False, {}), loop.robot, waits=True, capacity=100)
    held: list[int] = []
    tracemalloc.start()
    with recorder:
        for number in range(4000):
            recorder(changed(tick, now=tick.start.now + 1e-3 * number))
            if number % 1000 == 999:
                while len(recorder._queue):
                    time.sleep(1e-3)
                held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert recorder.summary.lost_ticks == 0
    # What waits for the next chunk is some megabytes at any time.
    assert max(held[1:]) - held[0] < 8e6
