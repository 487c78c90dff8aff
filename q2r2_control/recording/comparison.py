"""Whether a replay does what was recorded, bit for bit; and what around it is not as it was."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import yaml

from q2r2_control.config.cell import Config
from q2r2_control.recording import topics as names
from q2r2_control.recording.about import About, as_yaml, program
from q2r2_control.recording.encoder import RecordedRobot, TickEncoder
from q2r2_control.recording.packing import TickPacker
from q2r2_control.recording.reader import RecordedChunk
from q2r2_control.recording.rows import Rows, log_time, text_of
from q2r2_control.recording.topics import Topic, Topics
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick

_BATCH = 64
_AXES = ("x", "y", "z", "w")


class Comparison:
    """A listener of a replay that holds its messages to the recorded ones. How long a tick took is left out."""

    keeps_episodes = True  # as when it was recorded

    def __init__(self, robot: Robot, topics: Topics, epoch: int) -> None:
        self._topics, self._epoch = topics, epoch
        self._packer = TickPacker(topics)
        self._encoder = TickEncoder(RecordedRobot.of(robot), topics, epoch)
        self._pairs = {topic.name: _Pair() for topic in topics.all}
        self._differences: dict[str, tuple[int, str]] = {}  # the first of each topic: time [ns] and what
        self._batch: list[bytes] = []
        self._count = 0
        labels = topics.by_name[names.TICK].labels["data"]
        self._timings = [labels.index(name) for name in names.TIMINGS]

    def expect(self, chunk: RecordedChunk) -> None:
        """Take recorded messages."""
        for name, rows in chunk.rows.items():
            self._pairs[name].recorded += self._records(name, rows)
        for name, texts in chunk.texts.items():
            self._pairs[name].recorded += texts

    def __call__(self, tick: Tick) -> None:
        """Take one tick of the replay."""
        self._batch.append(self._packer.pack(self._count, tick))
        self._count += 1
        if len(self._batch) == _BATCH:
            self._compare()

    def finish(self, whole: bool) -> None:
        """Compare what is left, after the replay; ``whole``: of all that was recorded, so nothing may be left."""
        self._compare()
        if not whole:
            return
        for name, pair in self._pairs.items():
            if name not in self._differences and len(pair.recorded) != len(pair.replayed):
                which, left = ("recorded", pair.recorded) if pair.recorded else ("replayed", pair.replayed)
                self._note(name, log_time(left[0]), f"{len(left)} messages were {which} only")

    @property
    def difference(self) -> str | None:
        """The first in time; of those at one time that of the first topic, so that a cause comes before its effects."""
        found = [
            (time, topic.channel, f"{(time - self._epoch) * 1e-9:.6f} s: {topic.name}: {text}")
            for topic in self._topics.all
            if topic.name in self._differences
            for time, text in [self._differences[topic.name]]
        ]
        return min(found)[2] if found else None

    def _records(self, name: str, rows: Rows) -> list[bytes]:
        if name == names.TICK:
            # By its bytes, since a copy of rows leaves out what is between their fields.
            rows = np.frombuffer(bytearray(rows.tobytes()), dtype=rows.dtype)
            rows["data"][:, self._timings] = 0.0
        size, data = rows.dtype.itemsize, rows.tobytes()
        return [data[start : start + size] for start in range(0, len(data), size)]

    def _compare(self) -> None:
        blocks = self._encoder.encode(self._batch) if self._batch else []
        self._batch.clear()
        for block in blocks:
            name = block.topic.name
            self._pairs[name].replayed += block.texts if block.rows is None else self._records(name, block.rows)
        for name, pair in self._pairs.items():
            for recorded, replayed in pair.take():
                if recorded != replayed and name not in self._differences:
                    self._look(self._topics.by_name[name], recorded, replayed)

    def _look(self, topic: Topic, recorded: bytes, replayed: bytes) -> None:
        """Note what is different between two messages."""
        before, after = log_time(recorded), log_time(replayed)
        if before != after:
            which = "recorded" if before < after else "replayed"
            self._note(topic.name, min(before, after), f"a message was {which} only")
            return
        values = [_values(topic, record) for record in (recorded, replayed)]
        for (name, old), (_, new) in zip(*values, strict=False):
            if old != new and not (old != old and new != new):
                self._note(topic.name, before, f"{name}: recorded {old!r}, replayed {new!r}")
                return
        self._note(topic.name, before, "a bit that changes no value")

    def _note(self, name: str, time: int, text: str) -> None:
        self._differences[name] = time, text


class _Pair:
    """Messages of one topic that have not been compared yet."""

    def __init__(self) -> None:
        self.recorded: list[bytes] = []
        self.replayed: list[bytes] = []

    def take(self) -> Iterator[tuple[bytes, bytes]]:
        """Those that there are two of."""
        count = min(len(self.recorded), len(self.replayed))
        recorded, self.recorded = self.recorded[:count], self.recorded[count:]
        replayed, self.replayed = self.replayed[:count], self.replayed[count:]
        return zip(recorded, replayed, strict=True)


def _values(topic: Topic, record: bytes) -> Iterator[tuple[str, Any]]:
    """All values of a message, by name."""
    if topic.row is None:
        text = text_of(record)
        yield from json.loads(text).items() if text.startswith("{") else [("data", text)]
        return
    row = np.frombuffer(record, dtype=topic.row.dtype)[0]
    for field in row.dtype.names or ():
        values = np.atleast_1d(row[field]).tolist()
        labels = topic.labels.get(field, _AXES)
        for index, value in enumerate(values):
            yield field if len(values) == 1 else f"{field}[{labels[index]}]", value


def changes(about: About, config: Config, robot: Robot) -> list[str]:
    """What is not as it was when a run was recorded: program, libraries, cell, robot; a line each."""
    now = program()
    found = [
        f"{name}: {about.notes[name]} when recorded, now {now.get(name, 'unknown')}"
        for name in ("version", "revision", "libraries")
        if name in about.notes and about.notes[name] != now.get(name)
    ]
    if about.cell != as_yaml(config):
        old, new = dict(_flat(yaml.safe_load(about.cell))), dict(_flat(yaml.safe_load(as_yaml(config))))
        for key in dict.fromkeys((*old, *new)):
            if old.get(key) != new.get(key):
                found.append(f"cell: {key}: {old.get(key, 'nothing')} when recorded, now {new.get(key, 'nothing')}")
    if about.robot != robot.urdf:
        found.append("the robot's description is not the recorded one")
    return found


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, Mapping) and data:
        for name, value in data.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    else:
        yield key, data
