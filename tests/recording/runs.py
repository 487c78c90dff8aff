"""Recorded runs for tests."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.inputs.base import Input
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import Plant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.process.helper_process import HelperProcess
from q2r2_control.recording.about import About
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import Message
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import ROOM, Recorder, RecordingSummary
from q2r2_control.recording.tick_rows import tick_labels
from tests.support.processes import pipeline_of

ROOT = Path(__file__).resolve().parents[2]
ARMS = ("left", "right")
JOINTS = tuple(f"{arm}_A{number}" for arm in ARMS for number in range(1, 8))
# The lowest rate at which a tick has only one substep [Hz]. It is low because ticks take most of a test's time.
RATE = 500.0


# The program reads a bag with rosbags alone, in a process without this package.
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
    command = (sys.executable, "-c", READER, str(path))
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def pipeline(
    trajectory: str = "circle",
    plant: Plant | str = "kinematic",
    mode: str = "position",
    human: bool = False,
    source: Input | None = None,
    **changes: object,
) -> Pipeline:
    """Return a pipeline at :data:`RATE`. It has cameras only if ``changes`` has some, because drawing takes long."""
    hands = source or ScriptedInput(trajectory, human=human, seed=3, frequency_hz=0.5)
    return pipeline_of({"loop_rate_hz": RATE, "cameras": {}, **changes}, hands, plant, mode)


def record(
    folder: Path,
    loop: Pipeline,
    duration: float,
    *,
    realtime: bool = False,
    room: int = ROOM,
    waits: bool = True,
    during: Callable[[Recorder], None] = lambda recorder: None,
) -> RecordingSummary:
    """Record a run, with its cameras if it has some. ``during`` is called with the recorder just before the run."""
    cameras = loop.config.cameras
    with Recorder(folder, "test", waits=waits and not realtime, room=room, pictures=bool(cameras)) as recorder:
        if cameras:
            assert isinstance(loop.plant, MujocoPlant)
            recorder.prepare(loop.plant, loop.robot, cameras)
        recorder.begin(About.of(loop, realtime, {"task": "a test"}, tuple(cameras)), loop.robot)
        loop.listeners.append(recorder)
        during(recorder)
        loop.run(duration, realtime=realtime)
    loop.listeners.remove(recorder)
    return recorder.summary


def writer_of(recorder: Recorder) -> HelperProcess:
    assert recorder.writer is not None
    return recorder.writer


def file_of(summary: RecordingSummary) -> Path:
    """Return the file of a recording, and assert that it has no fault and lost no tick."""
    assert summary.fault is None
    assert summary.lost_ticks == 0
    assert summary.file is not None
    return Path(summary.file)


def rewrite(file: Path, target: Path, change: Callable[[str, Message], Message | None], *, whole: bool = True) -> Path:
    """Write a copy of ``file`` to ``target``, in chunks of 200 ticks.

    ``change`` gets the topic of each message and the message. It returns the message to write, or None to leave it out.
    If ``whole`` is False, the copy ends like the file of a writer that was killed.
    """
    recording = Recording(file)
    topics = recording.declared_topics
    with BagWriter(target, topics.values(), recording.about) as bag:
        ordered = chain.from_iterable(recording.messages())
        for _, messages in groupby(ordered, key=lambda message: message.number // 200):
            changed = (change(topics[message.channel].name, message) for message in messages)
            bag.write(message for message in changed if message is not None)
            bag.flush()
        if whole:
            bag.close(recording.conclusion)
    return target


def number_of(label: str) -> int:
    return tick_labels(ARMS, JOINTS).index(label)


def ended_line(caplog: pytest.LogCaptureFixture) -> str:
    """Return the reason why a recording ended, from the only line that is logged."""
    (line,) = caplog.messages
    assert line.startswith("recording ended, the run goes on: ")
    return line.partition(": ")[2]
