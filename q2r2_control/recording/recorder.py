"""Records a run while it goes on: a listener that only packs ticks, and a process that writes them.

One file a run, from its start on: what the loop remembers from before the first engagement (filters, anchors, grippers)
is part of what a replay has to repeat.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.base_recorder import PATIENCE, BaseRecorder
from q2r2_control.recording.camera_process import CameraProcess
from q2r2_control.recording.encoder import RecordedRobot
from q2r2_control.recording.helper import reason_of
from q2r2_control.recording.packing import TickPacker
from q2r2_control.recording.picture_channel import PictureChannel
from q2r2_control.recording.topics import Topics
from q2r2_control.recording.writer_process import ROOM
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick

_LOOKS = 64  # ticks between two looks at whether the writer lives
_MOST_WAITING = 4  # ticks that may wait to be packed
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
    ``waits``: a tick waits for room, as it may in simulated time; otherwise it is lost, and counted. With ``pictures``
    there is one more process, which takes those of the cameras of :meth:`prepare`.
    """

    keeps_episodes = True  # its operator can tell where one begins and ends

    def __init__(
        self, parent: Path, name: str, *, waits: bool = False, room: int = ROOM, pictures: bool = False
    ) -> None:
        """``room`` [bytes] for ticks that wait to be written."""
        self._waits = waits
        self._count = self._written = 0  # ticks
        self.overflows = 0  # ticks for which there was no room
        self._packer: TickPacker | None = None  # None: not begun
        self._waiting: deque[tuple[int, Tick]] = deque()
        self._channel: PictureChannel | None = None
        self.cameras: CameraProcess | None = None
        self._pictures_fault: str | None = None
        self._epoch = 0
        self.success: bool | None = None  # of the run, where its task has a check of its own, set before the end
        if pictures:
            try:
                self._channel = PictureChannel()
            except OSError as error:
                self._fail_pictures(reason_of(error))
        super().__init__(parent, name, room, self._channel)
        if self._channel is not None and self.writer is not None:
            try:
                self.cameras = CameraProcess(self._channel)
            except OSError as error:
                self._fail_pictures(reason_of(error))
        if self._channel is not None:
            self._channel.close()

    def prepare(self, plant: MujocoPlant, robot: Robot, cameras: Mapping[str, CameraConfig]) -> None:
        """Make ready to take pictures of a run of ``plant``, just before :meth:`begin`; some seconds at most."""
        if self.cameras is None:
            return
        try:
            self.cameras.prepare(plant, cameras, Topics(tuple(robot.arms), tuple(robot.joint_names), tuple(cameras)))
        except (OSError, ValueError) as error:
            self._fail_pictures(reason_of(error))
        self._look_at_cameras()

    def begin(self, about: About, robot: Robot) -> None:
        """Take ticks from now on, of a run that begins at ``about.epoch``."""
        topics = about.topics()
        if self._open(about, RecordedRobot.of(robot), tuple(topics.all)):
            self._packer, self._epoch = TickPacker(topics), about.epoch

    def __call__(self, tick: Tick) -> None:
        """Take one tick; never raises, and waits in simulated time only."""
        number, self._count = self._count, self._count + 1
        if self._fault is not None or self._packer is None:
            return
        self._take_pictures(number, tick)
        self._waiting.append((number, tick))
        # Ticks that take samples of hands are the longest ones; those between them, if there are any, have time.
        if not tick.samples or len(self._waiting) >= _MOST_WAITING:
            self._pack()

    def _pack(self) -> None:
        """Give the writer all ticks that wait."""
        try:
            while self._waiting and self._fault is None:
                number, tick = self._waiting.popleft()
                self._put(number, tick)
        except Exception as error:  # the arms move on, whatever it is
            self._fail(reason_of(error))

    def _put(self, number: int, tick: Tick) -> None:
        assert self._packer is not None
        assert self.writer is not None
        record = self._packer.pack(number, tick)
        while not self.writer.ring.put(record):
            if not self._waits:
                self.overflows += 1
                self._packer.repeat_state()
                break
            time.sleep(1e-3)
            if self._look():
                return
        if number % _LOOKS == 0:
            self._look()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pack()
        # The pictures first: the writer waits for them.
        if self.cameras is not None and (fault := self.cameras.finish(0.0 if self._fault else PATIENCE)):
            self._fail_pictures(fault)
        ended_by = None if error is None else reason_of(error)[:_LONGEST_FAULT]
        self._written = self._end(Conclusion(self.success, ended_by))

    @property
    def summary(self) -> RecordingSummary:
        """After the run."""
        pictures = 0 if self._channel is None else self._channel.ring.written
        return RecordingSummary(
            file=None if self._path is None else str(self._path),
            ticks=self._written,
            lost_ticks=self._count - self._written,
            fault=self._fault,
            pictures=pictures,
            lost_pictures=0 if self.cameras is None else self.cameras.due - pictures,
            pictures_fault=self._pictures_fault,
        )

    def _take_pictures(self, number: int, tick: Tick) -> None:
        """Those that are due; whatever fails, ticks are recorded all the same."""
        if self.cameras is None:
            return
        try:
            while self._pictures_fault is None and not self.cameras.take(number, tick, self._epoch):
                if not self._waits:
                    break
                time.sleep(1e-3)
                self._look_at_cameras()
                if self._look():
                    break
            self.cameras.skip(tick)
            if number % _LOOKS == 0:
                self._look_at_cameras()
        except Exception as error:
            self._fail_pictures(reason_of(error))

    def _look_at_cameras(self) -> None:
        if self.cameras is not None and self._pictures_fault is None and (fault := self.cameras.fault()):
            self._fail_pictures(fault)

    def _fail_pictures(self, reason: str) -> None:
        """Log the first failure in one line; no more pictures are taken."""
        if self._pictures_fault is None:
            self._pictures_fault = reason
            _logger.warning("no more pictures are recorded, the run goes on: %s", reason)
