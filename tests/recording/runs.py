"""Recorded runs for tests."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from q2r2_control.inputs.base import Input
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline import Pipeline
from q2r2_control.plants.base import Plant
from q2r2_control.recording.about import About
from q2r2_control.recording.mcap_file import MAGIC
from q2r2_control.recording.recorder import CAPACITY, Recorder, RecordingSummary
from tests.support.watch import cell

RATE = 500.0  # [Hz], the lowest with one substep a tick, since most of a test's time goes by ticks


def pipeline(
    trajectory: str = "circle",
    plant: Plant | str = "kinematic",
    mode: str = "position",
    human: bool = False,
    source: Input | None = None,
    **changes: object,
) -> Pipeline:
    """A pipeline at :data:`RATE`."""
    config = cell().model_copy(update={"loop_rate_hz": RATE, **changes})
    hands = source or ScriptedInput(trajectory, human=human, seed=3, frequency_hz=0.5)
    return Pipeline.from_config(config, input=hands, plant=plant, mode=mode)


def record(
    folder: Path,
    loop: Pipeline,
    duration: float,
    *,
    realtime: bool = False,
    capacity: int = CAPACITY,
    waits: bool = True,
    during: Callable[[Recorder], None] = lambda recorder: None,
) -> RecordingSummary:
    """Record a run; ``during`` gets the recorder when it has begun."""
    about = About.of(loop, realtime, {"task": "a test"})
    recorder = Recorder(folder, "test", about, loop.robot, waits=waits and not realtime, capacity=capacity)
    loop.listeners.append(recorder)
    with recorder:
        during(recorder)
        loop.run(duration, realtime=realtime)
    loop.listeners.remove(recorder)
    return recorder.summary


def file_of(summary: RecordingSummary) -> Path:
    """The file of a recording without a fault."""
    assert summary.fault is None
    assert summary.lost_ticks == 0
    assert summary.file is not None
    return Path(summary.file)


def rewrite(file: Path, target: Path, change: Callable[[bytearray], None]) -> Path:
    """A copy whose messages were changed, with checksums that fit."""
    builder = RecordBuilder()
    with file.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            changed: McapRecord = record
            if isinstance(record, Chunk):
                data, size = get_chunk_data_stream(record)
                content = bytearray(data.read(size))
                change(content)
                changed = Chunk(
                    "zstd",
                    zstandard.compress(bytes(content)),
                    record.message_end_time,
                    record.message_start_time,
                    zlib.crc32(content),
                    size,
                )
            changed.write(builder)
    target.write_bytes(MAGIC + builder.end() + MAGIC)
    return target
