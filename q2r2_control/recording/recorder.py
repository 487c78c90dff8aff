"""Records a run while it goes on: a listener that only packs ticks, and a process that writes them.

One file a run, from its start on: what the loop remembers from before the first engagement (filters, anchors, grippers)
is part of what a replay has to repeat.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from q2r2_control.config.recording import CameraConfig
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.base_recorder import PATIENCE, BaseRecorder
from q2r2_control.recording.camera_recorder import CameraRecorder
from q2r2_control.recording.helper_process import reason_of
from q2r2_control.recording.messages import Message
from q2r2_control.recording.tick_rows import PackedTick, TickPacker
from q2r2_control.recording.topics import run_topics
from q2r2_control.recording.writer import MessageBatch, RecordedRobot, TickBatch
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick

ROOM = 8 << 20  # for ticks that wait to be written [bytes]; one of two arms with seven joints each takes 1.6 kB
_BATCH = 16  # ticks that are sent at once
_LONGEST_FAULT = 500  # that ended a run [characters]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    """What became of a recording."""

    file: str | None  # None: none could be made
    ticks: int  # written
    lost_ticks: int  # that came while there was no room, or after the disk had failed
    fault: str | None  # why it ended before the run did
    pictures: int = 0  # written
    lost_pictures: int = 0  # that were due and are not there
    pictures_fault: str | None = None  # why they ended before the run did


class Recorder(BaseRecorder):
    """A listener of one run, as a context around it. It raises nothing: what fails is logged once, and the run goes on.

    Its process starts with it, so make it before what takes long, and :meth:`begin` when the run is about to begin.
    ``waits``: ticks wait for room, as they may in simulated time; otherwise they are lost, and counted. With
    ``pictures`` there is one more process, which takes those of the cameras of :meth:`prepare`.
    """

    keeps_episodes = True  # its operator can tell where one begins and ends

    def __init__(
        self, parent: Path, name: str, *, waits: bool = False, room: int = ROOM, pictures: bool = False
    ) -> None:
        """``room`` [bytes] for ticks that wait to be written."""
        self._waits = waits
        self._count = 0  # ticks
        self.overflows = 0  # ticks for which there was no room
        self._packer: TickPacker | None = None  # None: not begun
        self._batch: list[PackedTick] = []
        self._epoch = 0
        self.success: bool | None = None  # of the run, where its task has a check of its own, set before the end
        self.cameras: CameraRecorder | None = None
        self._pictures_fault: str | None = None
        super().__init__(parent, name, room)
        if pictures:
            try:
                self.cameras = CameraRecorder(self._write_picture)
            except OSError as error:
                self._fail_pictures(reason_of(error))

    def prepare(self, plant: MujocoPlant, robot: Robot, cameras: Mapping[str, CameraConfig]) -> None:
        """Make ready to take pictures of a run of ``plant``, just before :meth:`begin`; some seconds at most."""
        if self.cameras is not None:
            topics = run_topics(tuple(robot.arms), tuple(robot.joint_names), tuple(cameras))
            self.cameras.prepare(plant, cameras, topics)
            self._check_cameras()

    def begin(self, about: About, robot: Robot) -> None:
        """Take ticks from now on, of a run that begins at ``about.epoch``."""
        topics = about.topics()
        if self._open(about, RecordedRobot.of(robot), tuple(topics.values())):
            self._packer, self._epoch = TickPacker(about.arms, about.joints), about.epoch

    def __call__(self, tick: Tick) -> None:
        """Take one tick; never raises, and waits in simulated time only."""
        number, self._count = self._count, self._count + 1
        if self.fault is not None or self._packer is None:
            return
        try:
            self._batch.append(self._packer.pack(number, tick))
            if len(self._batch) >= _BATCH:
                self._send_batch()
        except Exception as error:  # the arms move on, whatever it is
            self._fail(reason_of(error))
        if self.cameras is not None:
            self._take_pictures(self.cameras, number, tick)

    def _send_batch(self) -> None:
        """Send all ticks that wait; those for which there is no room are lost."""
        batch, self._batch = self._batch, []
        if batch and not self._send(TickBatch(batch), wait=self._waits) and self._packer is not None:
            self.overflows += len(batch)
            self._packer.repeat_state()

    def _take_pictures(self, cameras: CameraRecorder, number: int, tick: Tick) -> None:
        """Those that are due; whatever fails, ticks are recorded all the same."""
        try:
            cameras.take_pictures(number, tick, self._epoch, wait=self._waits)
        except Exception as error:
            self._fail_pictures(reason_of(error))
        self._check_cameras()

    def _write_picture(self, picture: Message) -> None:
        """Called in the thread that hears of the cameras, which may wait for room."""
        if self.writer is not None:
            self.writer.send(batch := MessageBatch([picture]), batch.size, wait=True)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._send_batch()
        if self.cameras is not None:
            self.cameras.finish(0.0 if self.fault else PATIENCE)
            self._check_cameras()
        self._end(Conclusion(self.success, None if error is None else reason_of(error)[:_LONGEST_FAULT]))

    @property
    def summary(self) -> RecordingSummary:
        """After the run."""
        pictures = self.written.messages
        return RecordingSummary(
            file=None if self.file is None else str(self.file),
            ticks=self.written.ticks,
            lost_ticks=self._count - self.written.ticks,
            fault=self.fault,
            pictures=pictures,
            lost_pictures=0 if self.cameras is None else self.cameras.due - pictures,
            pictures_fault=self._pictures_fault,
        )

    def _check_cameras(self) -> None:
        if self.cameras is not None and self.cameras.fault is not None:
            self._fail_pictures(self.cameras.fault)

    def _fail_pictures(self, reason: str) -> None:
        """Log the first failure in one line; no more pictures are taken."""
        if self._pictures_fault is None:
            self._pictures_fault = reason
            _logger.warning("no more pictures are recorded, the run goes on: %s", reason)
