"""The process that writes a recording: it makes messages of packed ticks and writes them.

It imports none of the modules that compute: :class:`BaseRecorder` starts it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.encoder import RecordedRobot, TickEncoder
from q2r2_control.recording.messages import Message
from q2r2_control.recording.tick_rows import PackedTick
from q2r2_control.recording.topics import Topic

FLUSH_PERIOD = 0.5  # of the file; what is lost at most where this process is killed [s]
_NICENESS = 10  # the loop goes first where there are not enough processors


@dataclass(frozen=True)
class RecordingSetup:
    """The first request."""

    path: Path  # of the file, in a folder that is there
    about: About
    topics: tuple[Topic, ...]  # of the file
    robot: RecordedRobot | None = None  # of packed ticks


class TickBatch(NamedTuple):
    """Ticks one after the other, packed by :class:`TickPacker`."""

    ticks: list[PackedTick]

    @property
    def size(self) -> int:
        """Of all [bytes]."""
        return sum(tick.size for tick in self.ticks)


class MessageBatch(NamedTuple):
    """Messages, to be written as they are."""

    messages: list[Message]

    @property
    def size(self) -> int:
        """Of all [bytes]."""
        return sum(len(message.payload) for message in self.messages)


class Written(NamedTuple):
    """An answer: how much of what was sent is in the file."""

    ticks: int = 0
    messages: int = 0  # of message batches


def main(requests: Iterator[Any], answer: Callable[[Written], None]) -> None:
    """Write one recording. Raises :class:`OSError`, with a file that has what was written before."""
    with suppress(OSError):
        os.nice(_NICENESS)
    setup = next((request for request in requests if request is not None), None)
    if not isinstance(setup, RecordingSetup):
        return  # there was no run
    about = setup.about
    encoder = TickEncoder(setup.robot, about.topics(), about.epoch) if setup.robot is not None else None
    received, conclusion = Written(), Conclusion()
    due = time.monotonic() + FLUSH_PERIOD
    with BagWriter(setup.path, setup.topics, about) as bag:
        for request in requests:
            if isinstance(request, Conclusion):
                conclusion = request
            elif isinstance(request, MessageBatch):
                bag.write(request.messages)
                received = received._replace(messages=received.messages + len(request.messages))
            elif isinstance(request, TickBatch):
                assert encoder is not None
                bag.write(encoder.encode(request.ticks))
                received = received._replace(ticks=received.ticks + len(request.ticks))
            if time.monotonic() >= due:
                bag.flush()
                answer(received)
                due = time.monotonic() + FLUSH_PERIOD
        bag.close(conclusion)
    answer(received)
