"""What the process beside the loop does: takes ticks out of the ring, encodes, compresses and writes them.

It ends by itself once the run's end of its standard input is closed, by a run that has ended or that was killed, with
all of the ring written and the file closed. It imports none of what computes: :class:`WriterProcess` starts it.
"""

from __future__ import annotations

import json
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.recording.about import ABOUT, CELL, FIELDS, ROBOT, About
from q2r2_control.recording.bag import definitions, qos_text, write_metadata
from q2r2_control.recording.encoder import RecordedRobot, TickEncoder, in_order
from q2r2_control.recording.helper import be_nice, has_ended
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.picture_channel import PictureSource
from q2r2_control.recording.ring import Ring
from q2r2_control.recording.rows import channel_of
from q2r2_control.recording.topics import Topics

# Between two looks at the ring [s]; a few ticks take nearly as long to encode as many.
_PERIOD = 0.1
_BATCH = 256  # ticks
_CHUNK_TIME = 0.5  # what is lost at most where this process is killed too, with what is being written [s]
_CHUNK_SIZE = 4 << 20  # [bytes]
_NICENESS = 10  # the loop goes first where there are not enough processors


@dataclass(frozen=True)
class Setup:
    """The first record in the ring."""

    path: Path  # of the file, in a folder that is there
    about: About
    robot: RecordedRobot


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
    assert isinstance(setup, Setup)
    ring.release()
    file = McapFile(setup.path)
    try:
        _write(ring, pictures, file, setup, parent)
    finally:
        file.abandon()


def _write(ring: Ring, pictures: PictureSource | None, file: McapFile, setup: Setup, parent: int) -> None:
    about, topics = setup.about, setup.about.topics()
    _begin(file, about, topics)
    # Once before the run too, so that what a killed process leaves is a bag.
    write_metadata(setup.path, topics.all, {}, about.epoch, about.epoch, about.notes)
    encoder = TickEncoder(setup.robot, topics, about.epoch)
    count, due = 0, time.monotonic() + _CHUNK_TIME
    over = ended = False  # the run; all that writes to the rings
    while True:
        batch = ring.take(_BATCH)
        if batch:
            file.add(in_order(encoder.encode(batch)))
            ring.release()
            count += len(batch)
        taken = _write_pictures(pictures, file, topics)
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
    file.close()
    write_metadata(setup.path, topics.all, file.counts, file.first_time, file.last_time, about.notes)


def _write_pictures(pictures: PictureSource | None, file: McapFile, topics: Topics) -> int:
    """Write the pictures that there are, as a chunk of their own; returns how many."""
    records = [] if pictures is None else pictures.take()
    if pictures is not None and records:
        file.add_apart([(topics.by_channel[channel_of(record)], record) for record in records])
        pictures.written(len(records))
    return len(records)


def _begin(file: McapFile, about: About, topics: Topics) -> None:
    """Write what is said once."""
    file.add_topics(topics.all, definitions(topics.all), qos_text())
    file.add_metadata(ABOUT, about.texts())
    labels = {topic.name: topic.labels for topic in topics.all if topic.labels}
    for name, kind, text in (
        (CELL, "application/yaml", about.cell),
        (ROBOT, "application/xml", about.robot),
        (FIELDS, "application/json", json.dumps(labels)),
    ):
        file.add_attachment(name, kind, text, about.epoch)
    file.begin()
