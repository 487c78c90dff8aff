"""What recorders have in common: a new folder for each run, the process that writes there, and one line if it fails."""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.process.folders import new_folder
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.encoder import RecordedRobot
from q2r2_control.recording.helper import reason_of
from q2r2_control.recording.picture_channel import PictureChannel
from q2r2_control.recording.topics import Topic
from q2r2_control.recording.writer import RingSetup
from q2r2_control.recording.writer_process import WriterProcess

PATIENCE = 10.0  # for a disk that hangs, at the end of a run [s]

_logger = logging.getLogger(__name__)


class BaseRecorder:
    """Raises nothing: what fails is logged once, and the run goes on."""

    def __init__(self, parent: Path, name: str, room: int, channel: PictureChannel | None = None) -> None:
        """Start the process; ``room`` [bytes] is for what waits to be written."""
        self._parent, self._name = parent, name
        self._fault: str | None = None
        self._path: Path | None = None
        self.writer: WriterProcess | None = None
        self.record_outcome: Callable[[Reason], None] = lambda reason: None  # lets the operator know of the failure
        try:
            self.writer = WriterProcess(room, channel)
        except (OSError, ValueError) as error:
            self._fail(reason_of(error))

    @property
    def fault(self) -> str | None:
        """Why nothing more is recorded."""
        return self._fault

    @property
    def file(self) -> Path | None:
        """What is written; None while there is no file."""
        return self._path

    def _open(self, about: About, robot: RecordedRobot | None, topics: tuple[Topic, ...]) -> bool:
        """Have the file of a run begun that begins at ``about.epoch``; whether that was possible."""
        if self.writer is None:
            return False
        try:
            # The time of day, so that recordings are listed in their order.
            when = datetime.fromtimestamp(about.epoch * 1e-9)
            folder = new_folder(self._parent, f"{when:%Y%m%d-%H%M%S}-{self._name}", "--record")
            self._path = folder / f"{folder.name}.mcap"
            self.writer.begin(RingSetup(self._path.absolute(), about, robot, topics))
        except (ConfigError, OSError, ValueError) as error:
            self._fail(reason_of(error))
        return self._fault is None

    def _end(self, conclusion: Conclusion) -> int:
        """Let all be written, with ``conclusion`` as the last; returns how many records are in the file."""
        if self.writer is None:
            return 0
        if fault := self.writer.finish(PATIENCE, conclusion):
            self._fail(fault)
        return self.writer.ring.written

    def _look(self) -> bool:
        """Whether the writer has ended."""
        assert self.writer is not None
        if fault := self.writer.fault():
            self._fail(fault)
        return fault is not None

    def _fail(self, reason: str) -> None:
        """Log the first failure in one line; nothing more is recorded."""
        if self._fault is None:
            self._fault = f"{self._path}: {reason}" if self._path is not None else reason
            _logger.warning("recording ended, the run goes on: %s", self._fault)
            self.record_outcome(Reason.of(ReasonKind.RECORDING_ENDED, text=self._fault))
