"""What the process beside the loop does: takes ticks out of the ring, encodes, compresses and writes them.

It ends by itself once the run's end of its standard input is closed, by a run that has ended or that was killed, with
all of the ring written and the file closed. It imports none of what computes: :class:`WriterProcess` starts it.
"""

from __future__ import annotations

import json
import os
import pickle
import select
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from q2r2_control.recording.about import ABOUT, CELL, FIELDS, ROBOT, About
from q2r2_control.recording.bag import definitions, qos_text, write_metadata
from q2r2_control.recording.encoder import RecordedRobot, TickEncoder, in_order
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.ring import Ring
from q2r2_control.recording.topics import Topics

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # for the run, which says when it has ended
# Between two looks at the ring [s]; a few ticks take nearly as long to encode as many.
_PERIOD = 0.1
_BATCH = 256  # ticks
_CHUNK_TIME = 0.5  # what is lost at most where this process is killed too, with what is being written [s]
_CHUNK_SIZE = 4 << 20  # [bytes]
LONGEST_REASON = 1000  # of a failure [bytes]
_NICENESS = 10  # the loop goes first where there are not enough processors


@dataclass(frozen=True)
class Setup:
    """The first record in the ring."""

    path: Path  # of the file, in a folder that is there
    about: About
    robot: RecordedRobot


def main(memory: int, parent: int) -> None:
    """Write one recording. ``memory``: the ring's descriptor; ``parent``: number of the process that runs the loop."""
    try:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        with suppress(OSError):
            os.nice(_NICENESS)
        _record(Ring(memory), parent)
    except Exception as error:
        os.write(sys.stdout.fileno(), reason_of(error).encode()[:LONGEST_REASON])


def reason_of(error: Exception) -> str:
    """One line that says what went wrong."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or repr(error)
    return " ".join(reason.split())


def _record(ring: Ring, parent: int) -> None:
    """Write all that comes. Raises whatever goes wrong, then with a whole file of what was written before."""
    ended = False
    while not (first := ring.take(1)):
        if ended:
            return  # there was no run
        ended = _has_ended(parent)
    setup = pickle.loads(first[0])
    assert isinstance(setup, Setup)
    ring.release()
    file = McapFile(setup.path)
    try:
        _write(ring, file, setup, parent)
    finally:
        file.abandon()


def _write(ring: Ring, file: McapFile, setup: Setup, parent: int) -> None:
    about, topics = setup.about, Topics(setup.about.arms, setup.about.joints)
    _begin(file, about, topics)
    # Once before the run too, so that what a killed process leaves is a bag.
    write_metadata(setup.path, topics.all, {}, about.epoch, about.epoch, about.notes)
    encoder = TickEncoder(setup.robot, topics, about.epoch)
    count, due = 0, time.monotonic() + _CHUNK_TIME
    ended = False
    while True:
        batch = ring.take(_BATCH)
        if batch:
            file.add(in_order(encoder.encode(batch)))
            ring.release()
            count += len(batch)
        drained = ended and not batch
        if drained or time.monotonic() >= due or file.pending > _CHUNK_SIZE:
            file.flush()
            ring.written, due = count, time.monotonic() + _CHUNK_TIME
        if drained:
            break
        if len(batch) < _BATCH:
            # Before the ring is looked at once more: nothing is added to it afterwards.
            ended = ended or _has_ended(parent)
    file.close()
    write_metadata(setup.path, topics.all, file.counts, file.first_time, file.last_time, about.notes)


def _has_ended(parent: int) -> bool:
    """Whether the run has ended, or does within a short while."""
    # Processes that the loop's has started may have the other end of the input too, and outlive it.
    return bool(select.select([sys.stdin], [], [], _PERIOD)[0]) or os.getppid() != parent


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
