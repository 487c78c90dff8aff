"""Records a run while it goes on: a listener that only keeps ticks, and a thread that writes them.

One file a run, from its start on: what the loop remembers from before the first engagement (filters, anchors, grippers)
is part of what a replay has to repeat.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import TracebackType

from q2r2_control.errors import ConfigError
from q2r2_control.recording.about import ABOUT, CELL, FIELDS, ROBOT, About
from q2r2_control.recording.bag import definitions, qos_text, write_metadata
from q2r2_control.recording.encoder import NumberedTick, TickEncoder, in_order
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.topics import Topics
from q2r2_control.robot.robot import Robot
from q2r2_control.runtime.folders import new_folder
from q2r2_control.runtime.recorder import Tick

CAPACITY = 4000  # ticks that wait to be written
_PERIOD = 0.01  # between two looks at the queue [s]
# At once, since the loop's thread may have to wait for the interpreter meanwhile: some 0.3 ms.
_BATCH = 16
_CHUNK_TIME = 0.5  # what a killed process loses at most, with what waits and what is being written [s]
_CHUNK_SIZE = 4 << 20  # [bytes]
_PATIENCE = 10.0  # for a disk that hangs, at the end of a run [s]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What became of a recording."""

    file: str | None  # None: none could be made
    ticks: int  # written
    lost_ticks: int  # that came while the queue was full, or after the disk had failed
    fault: str | None  # why it ended before the run did


class Recorder:
    """A listener of one run, as a context around it. It raises nothing: what fails is logged once, and the run goes on.

    ``waits``: a tick waits for room in the queue, as it may in simulated time; otherwise it is lost, and counted.
    """

    def __init__(
        self, parent: Path, name: str, about: About, robot: Robot, *, waits: bool = False, capacity: int = CAPACITY
    ) -> None:
        self._waits, self._capacity = waits, capacity
        self._queue: deque[NumberedTick] = deque()
        self._count = self._written = 0  # ticks
        self._ending = False
        self._fault: str | None = None
        self._file: McapFile | None = None
        self._path: Path | None = None
        self._topics = Topics(about.arms, about.joints)
        self._encoder = TickEncoder(robot, self._topics, about.epoch)
        self._custom = dict(about.notes)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        try:
            # The time of day, so that recordings are listed in their order.
            when = datetime.fromtimestamp(about.epoch * 1e-9)
            folder = new_folder(parent, f"{when:%Y%m%d-%H%M%S}-{name}", "--record")
            self._path = folder / f"{folder.name}.mcap"
            self._begin(self._path, about)
        except (ConfigError, OSError) as error:
            self._fail(error)

    def __call__(self, tick: Tick) -> None:
        """Take one tick; never raises, and waits in simulated time only."""
        number, self._count = self._count, self._count + 1
        while self._waits and len(self._queue) >= self._capacity and self._fault is None:
            time.sleep(1e-3)
        if self._fault is None and len(self._queue) < self._capacity:
            self._queue.append((number, tick))

    def __enter__(self) -> Recorder:
        if self._fault is None:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending = True
        if self._thread.ident is None:
            return
        self._thread.join(_PATIENCE)
        if self._thread.is_alive():
            self._fail(TimeoutError(f"the disk took no data for {_PATIENCE:g} s"))

    @property
    def summary(self) -> RecordingSummary:
        """After the run."""
        return RecordingSummary(
            file=None if self._path is None else str(self._path),
            ticks=self._written,
            lost_ticks=self._count - self._written,
            fault=self._fault,
        )

    def _begin(self, path: Path, about: About) -> None:
        file = McapFile(path)
        topics = self._topics.all
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
        # Once before the run too, so that what a killed process leaves is a bag.
        write_metadata(path, topics, {}, about.epoch, about.epoch, self._custom)
        self._file = file

    def _run(self) -> None:
        try:
            self._write()
        except Exception as error:  # the arms move on, whatever it is
            self._fail(error)
            if self._file is not None:
                with suppress(OSError):
                    self._file.abandon()

    def _write(self) -> None:
        file, due = self._file, time.monotonic() + _CHUNK_TIME
        assert file is not None
        unwritten = 0
        while True:
            ending = self._ending  # before the queue is looked at, which nothing is added to afterwards
            batch = [self._queue.popleft() for _ in range(min(_BATCH, len(self._queue)))]
            if batch:
                file.add(in_order(self._encoder.encode(batch)))
                unwritten += len(batch)
            now = time.monotonic()
            if now >= due or file.pending > _CHUNK_SIZE or (ending and not batch):
                file.flush()
                self._written, unwritten, due = self._written + unwritten, 0, now + _CHUNK_TIME
            if ending and not batch:
                break
            if len(batch) < _BATCH:
                time.sleep(_PERIOD)
            elif not self._waits:
                time.sleep(1e-4)  # lets the loop have the interpreter
        file.close()
        assert self._path is not None
        write_metadata(self._path, self._topics.all, file.counts, file.first_time, file.last_time, self._custom)

    def _fail(self, error: Exception) -> None:
        """Log the first failure in one line; nothing more is recorded."""
        if self._fault is not None:
            return
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or repr(error)
        self._fault = f"{self._path}: {reason}" if self._path is not None else reason
        _logger.warning("recording ended, the run goes on: %s", " ".join(self._fault.split()))
