"""Recorders: a new folder for each run, the process that writes there, and one line if it fails."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from datetime import datetime
from pathlib import Path

from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.process.scheduling import new_folder
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.helper_process import HelperProcess, reason_of
from q2r2_control.recording.messages import Message
from q2r2_control.recording.topics import Topic
from q2r2_control.recording.writer import FLUSH_PERIOD, MessageBatch, RecordedRobot, RecordingSetup, TickBatch, Written

PATIENCE = 10.0  # with a disk that hangs, at the end of a run [s]
ROOM = 8 << 20  # for messages that wait to be written [bytes]; both arms' nodes send some 0.6 MB a second
ROOM_WITH_PICTURES = 64 << 20  # of cameras, which have a megabyte each where they are not compressed
_LAST_NUMBER = 2**32 - 1

_logger = logging.getLogger(__name__)


class BaseRecorder:
    """Raises nothing: what fails is logged once, and the run goes on."""

    def __init__(self, parent: Path, name: str, room: int) -> None:
        """Start the process; ``room`` [bytes] is for what waits to be written."""
        self._parent, self._name = parent, name
        self.fault: str | None = None  # why nothing more is recorded
        self.file: Path | None = None  # that is written; None while there is none
        self.written = Written()
        self.writer: HelperProcess | None = None
        self.record_outcome: Callable[[Reason], None] = lambda reason: None  # lets the operator know of the failure
        try:
            module = "q2r2_control.recording.writer"
            self.writer = HelperProcess("writes it", module, self._on_written, room, idle=FLUSH_PERIOD)
        except OSError as error:
            self._fail(reason_of(error))

    def _on_written(self, written: Written) -> None:
        self.written = written

    def _open(self, about: About, robot: RecordedRobot | None, topics: tuple[Topic, ...]) -> bool:
        """Have the file of a run begun that begins at ``about.epoch``; whether that was possible."""
        if self.writer is None:
            return False
        try:
            # The time of day, so that recordings are listed in their order.
            when = datetime.fromtimestamp(about.epoch * 1e-9)
            folder = new_folder(self._parent, f"{when:%Y%m%d-%H%M%S}-{self._name}", "--record")
        except (ConfigError, OSError) as error:
            self._fail(reason_of(error))
            return False
        self.file = folder / f"{folder.name}.mcap"
        self.writer.send(RecordingSetup(self.file.absolute(), about, topics, robot))
        return True

    def _send(self, batch: TickBatch | MessageBatch, *, wait: bool = False) -> bool:
        """Have a batch written; False where there is no room for it now. ``wait`` for room."""
        if self.writer is None or self.fault is not None:
            return False
        sent = self.writer.send(batch, batch.size, wait=wait)
        self._check_writer()
        return sent

    def _end(self, conclusion: Conclusion) -> None:
        """Let all be written, with ``conclusion`` as the last."""
        if self.writer is None:
            return
        if self.file is not None:
            self.writer.send(conclusion)
        self.writer.finish(PATIENCE)
        self._check_writer()

    def _check_writer(self) -> None:
        """Find out whether the writer has failed."""
        if self.writer is not None and self.writer.fault is not None:
            self._fail(self.writer.fault)

    def _fail(self, reason: str) -> None:
        """Log the first failure in one line; nothing more is recorded."""
        if self.fault is None:
            self.fault = f"{self.file}: {reason}" if self.file is not None else reason
            _logger.warning("recording ended, the run goes on: %s", self.fault)
            self.record_outcome(Reason.of(ReasonKind.RECORDING_ENDED, text=self.fault))


class MessageRecorder(BaseRecorder):
    """Writes one file. It never waits: messages for which there is no room are lost, and counted."""

    def __init__(self, parent: Path, name: str, room: int = ROOM) -> None:
        super().__init__(parent, name, room)
        self.count = self.overflows = 0  # messages that came; those of them for which there was no room
        self._last = 0
        self._begun = False

    def begin(self, about: About, topics: tuple[Topic, ...]) -> None:
        """Take messages of these topics from now on."""
        self._begun = self._open(about, None, topics)
        self._last = about.epoch

    def record(self, messages: Iterable[Message]) -> None:
        """Have messages written, in the order of their receipt.

        One that was received before the last one counts as received with it, since a file is in the order of time.
        """
        batch = []
        for message in sorted(messages, key=lambda one: one.time):
            self.count += 1
            self._last = max(message.time, self._last)
            batch.append(message._replace(number=message.number & _LAST_NUMBER, time=self._last))
        self._check_writer()
        if batch and self._begun and self.fault is None and not self._send(MessageBatch(batch)):
            self.overflows += len(batch)

    def finish(self) -> None:
        """Write what there is, and close the file."""
        self._end(Conclusion())
