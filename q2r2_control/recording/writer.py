"""What the process beside the loop does: takes ticks out of the ring, encodes, compresses and writes them.

It ends by itself once the run's end of its standard input is closed, by a run that has ended or that was killed, with
all of the ring written and the file closed. It imports none of what computes: :class:`WriterProcess` starts it.
"""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.recording.about import ABOUT, CELL, CONCLUSION, FIELDS, ROBOT, About
from q2r2_control.recording.bag import definitions, qos_text, write_metadata
from q2r2_control.recording.encoder import RecordedRobot, TickEncoder, in_order
from q2r2_control.recording.helper import be_nice, has_ended, told
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.picture_channel import PictureSource
from q2r2_control.recording.ring import Ring
from q2r2_control.recording.rows import channel_of
from q2r2_control.recording.topics import Topic

# Between two looks at the ring [s]; a few ticks take nearly as long to encode as many.
_PERIOD = 0.1
_BATCH = 256  # ticks
_CHUNK_TIME = 0.5  # what is lost at most where this process is killed too, with what is being written [s]
_CHUNK_SIZE = 4 << 20  # [bytes]
_NICENESS = 10  # the loop goes first where there are not enough processors


@dataclass(frozen=True)
class RingSetup:
    """The first record in the ring."""

    path: Path  # of the file, in a folder that is there
    about: About
    robot: RecordedRobot | None  # None: what comes are not ticks but whole messages
    topics: tuple[Topic, ...]  # of the file


def main(memory: int, *rest: int) -> None:
    """Write one recording; ``memory`` is the ring's descriptor.

    ``rest``: where there are pictures, the two descriptors of a :class:`PictureSource`; then the number of the process
    that runs the loop.
    """
    be_nice(_NICENESS)
    *channel, parent = rest
    _record(Ring(memory), PictureSource(*channel) if channel else None, parent)


def _record(ring: Ring, pictures: PictureSource | None, parent: int) -> None:
    """Write all that comes. Raises whatever goes wrong, then with a whole file of what was written before."""
    ended = False
    while not (first := ring.take(1)):
        if ended:
            return  # there was no run
        ended = has_ended(parent, _PERIOD)
    setup = pickle.loads(first[0])
    assert isinstance(setup, RingSetup)
    ring.release()
    file = McapFile(setup.path)
    try:
        _write(ring, pictures, file, setup, parent)
    finally:
        file.abandon()


def _write(ring: Ring, pictures: PictureSource | None, file: McapFile, setup: RingSetup, parent: int) -> None:
    about, topics = setup.about, setup.topics
    _begin(file, about, topics)
    # Once before the run too, so that what a killed process leaves is a bag.
    write_metadata(setup.path, topics, {}, about.epoch, about.epoch, about.notes)
    by_channel = {topic.channel: topic for topic in topics}
    encode = _encoder(setup, by_channel)
    count, due = 0, time.monotonic() + _CHUNK_TIME
    over = ended = False  # the run; all that writes to the rings
    while True:
        batch = ring.take(_BATCH)
        if batch:
            file.add(encode(batch))
            ring.release()
            count += len(batch)
        taken = _write_pictures(pictures, file, by_channel)
        drained = ended and not batch
        if drained or time.monotonic() >= due or file.pending > _CHUNK_SIZE:
            file.flush()
            ring.written, due = count, time.monotonic() + _CHUNK_TIME
        if drained and not taken:
            break
        if len(batch) < _BATCH:
            # Before the rings are looked at once more: nothing is added to them afterwards.
            over = over or has_ended(parent, _PERIOD)
            ended = over and (pictures is None or pictures.has_ended(_PERIOD))
    conclusion = _conclusion()
    if conclusion:
        file.add_metadata(CONCLUSION, conclusion)
    file.close()
    notes = {**about.notes, **conclusion}
    write_metadata(setup.path, topics, file.counts, file.first_time, file.last_time, notes)


def _conclusion() -> dict[str, str]:
    """What the run has said at its end."""
    text = told()
    return dict(json.loads(text)) if text else {}


def _encoder(
    setup: RingSetup, topics: Mapping[int, Topic]
) -> Callable[[Sequence[bytes]], Sequence[tuple[Topic, bytes]]]:
    """What makes messages of records out of the ring."""
    if setup.robot is None:
        return lambda batch: [(topics[channel_of(record)], record) for record in batch]
    encoder = TickEncoder(setup.robot, setup.about.topics(), setup.about.epoch)
    return lambda batch: in_order(encoder.encode(batch))


def _write_pictures(pictures: PictureSource | None, file: McapFile, topics: Mapping[int, Topic]) -> int:
    """Write the pictures that there are, as a chunk of their own; returns how many."""
    records = [] if pictures is None else pictures.take()
    if pictures is not None and records:
        file.add_apart([(topics[channel_of(record)], record) for record in records])
        pictures.written(len(records))
    return len(records)


def _begin(file: McapFile, about: About, topics: Sequence[Topic]) -> None:
    """Write what is said once."""
    file.add_topics(topics, definitions(topics), qos_text())
    file.add_metadata(ABOUT, about.texts())
    labels = {topic.name: topic.labels for topic in topics if topic.labels}
    for name, kind, text in (
        (CELL, "application/yaml", about.cell),
        (ROBOT, "application/xml", about.robot),
        (FIELDS, "application/json", json.dumps(labels)),
    ):
        file.add_attachment(name, kind, text, about.epoch)
    file.begin()
