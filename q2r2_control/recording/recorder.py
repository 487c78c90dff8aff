"""Records a run, or what ROS nodes publish: a new folder for each, and a process that writes there."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from q2r2_control.config.recording import TOPIC_RATE, CameraConfig
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.process.helper_process import HelperProcess, reason_of
from q2r2_control.process.scheduling import new_folder
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.camera_recorder import CameraRecorder
from q2r2_control.recording.messages import Message, Topic, run_topics
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.tick_rows import PackedTick, TickPacker
from q2r2_control.recording.writer import FLUSH_PERIOD, RecordedRobot, RecordingSetup, Written
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick

if TYPE_CHECKING:  # the ROS node does without MuJoCo
    from q2r2_control.plants.mujoco import MujocoPlant

PATIENCE = 10.0  # with a disk that hangs, at the end of a run [s]
# For what waits to be sent [bytes], and the writer has as much: a tick of two arms takes 1.6 kB, both arms' nodes send
# some 0.6 MB a second.
ROOM = 4 << 20
_BEHIND, _CAUGHT_UP = 2.0, 1.0  # time by which the file is behind the run, to be said, and to be said anew later [s]
ROOM_WITH_PICTURES = 64 << 20  # of cameras of nodes, which have a megabyte each where they are not compressed
_LAST_NUMBER = 2**32 - 1
_BATCH = 16  # ticks that are sent at once
_LONGEST_FAULT = 500  # that ended a run [characters]

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
            on_written = partial(setattr, self, "written")
            self.writer = HelperProcess("writes it", module, on_written, room, idle=FLUSH_PERIOD)
        except OSError as error:
            self._check(reason_of(error))

    def _open(
        self, about: About, robot: RecordedRobot | None, topics: tuple[Topic, ...], topic_rate: float | None = None
    ) -> bool:
        """Have the file of a run begun that begins at ``about.epoch``; whether that was possible."""
        if self.writer is None:
            return False
        try:
            # The time of day, so that recordings are listed in their order.
            when = datetime.fromtimestamp(about.epoch * 1e-9)
            folder = new_folder(self._parent, f"{when:%Y%m%d-%H%M%S}-{self._name}", "--record")
        except (ConfigError, OSError) as error:
            self._check(reason_of(error))
            return False
        self.file = folder / f"{folder.name}.mcap"
        self.writer.send(RecordingSetup(self.file.absolute(), about, topics, robot, topic_rate))
        return True

    def _send(self, batch: list[PackedTick] | list[Message], *, wait: bool = False) -> bool:
        """Have some written; False where there is no room for them now. ``wait`` for room."""
        if self.writer is None or self.fault is not None:
            return False
        sent = self.writer.send(batch, sum(one.size for one in batch), wait=wait)
        self._check()
        return sent

    def finish(self, conclusion: Conclusion | None = None) -> None:
        """Write what there is with the ``conclusion``, and close the file."""
        if self.writer is not None:
            if self.file is not None:
                self.writer.send(conclusion or Conclusion())
            self.writer.finish(PATIENCE)
            self._check()
        if self.fault is not None and self.file is not None and _is_empty(self.file):
            with suppress(OSError):
                self.file.unlink(missing_ok=True)
                self.file.parent.rmdir()
            self.file = None

    def _check(self, fault: str | None = None) -> None:
        """Log the first ``fault``, or one of the writer, in one line; nothing more is recorded."""
        if fault is None and self.writer is not None:
            fault = self.writer.fault
        if fault is not None and self.fault is None:
            self.fault = f"{self.file}: {fault}" if self.file is not None else fault
            _logger.warning("recording ended, the run goes on: %s", self.fault)
            self.record_outcome(Reason.of(ReasonKind.RECORDING_ENDED, text=self.fault))


def _is_empty(file: Path) -> bool:
    """True if a file, as a writer that was killed leaves it, has no message."""
    try:
        recording = Recording(file)
    except RecordingError as error:  # messages come after what it lacks, unless the disk fails
        return not isinstance(error.__cause__, OSError) or not file.exists()
    try:
        return not any(recording.messages())
    except RecordingError:
        return False


class MessageRecorder(BaseRecorder):
    """Writes one file. It never waits: messages for which there is no room are lost, and counted."""

    def __init__(self, parent: Path, name: str, room: int = ROOM) -> None:
        super().__init__(parent, name, room)
        self.count = self.overflows = 0  # messages that came; those of them for which there was no room
        self._last = 0  # time of the newest message [ns of day]
        self._begun = False

    def begin(self, about: About, topics: tuple[Topic, ...]) -> None:
        self._begun, self._last = self._open(about, None, topics), about.epoch

    def record(self, messages: Iterable[Message]) -> None:
        """Have messages written, in the order of their receipt.

        One that was received before the last one counts as received with it: a file is in the order of time.
        """
        batch = []
        for message in sorted(messages, key=lambda one: one.time):
            self.count += 1
            self._last = max(message.time, self._last)
            batch.append(message._replace(number=message.number & _LAST_NUMBER, time=self._last))
        self._check()
        if batch and self._begun and self.fault is None and not self._send(batch):
            self.overflows += len(batch)


@dataclass(frozen=True, slots=True)
class RecordingSummary:
    file: str | None  # None: none could be made
    ticks: int  # written
    lost_ticks: int  # that came while there was no room, or after the disk had failed
    fault: str | None  # why it ended before the run did
    pictures: int = 0  # written
    lost_pictures: int = 0  # that were due and are not there
    pictures_fault: str | None = None  # why they ended before the run did
    longest_backlog_s: float = 0.0  # that waited to be written, at most; what a killed writer may cost


class Recorder(BaseRecorder, AbstractContextManager["Recorder"]):
    """A listener of one run, as a context around it. It raises nothing: what fails is logged once, and the run goes on.

    Its process starts with it, so make it before what takes long, and :meth:`begin` when the run is about to begin.
    """

    keeps_episodes = True  # its operator can tell where one begins and ends

    def __init__(
        self, parent: Path, name: str, *, waits: bool = False, room: int = ROOM, pictures: bool = False
    ) -> None:
        """``waits``: ticks wait for ``room`` [bytes], as they may in simulated time; else they are lost, and counted.

        With ``pictures`` there is one more process, which takes those of the cameras of :meth:`prepare`.
        """
        self._waits = waits
        self._count = 0  # ticks
        self.overflows = 0  # ticks for which there was no room
        self._packer: TickPacker | None = None  # None: not begun
        self._batch: list[PackedTick] = []
        self._sent: deque[tuple[int, float]] = deque()  # ticks by then, and the loop's time [s], of what is not written
        self._longest_backlog, self._said_so = 0.0, False
        self._epoch = 0
        self.success: bool | None = None  # of the run, where its task has a check of its own, set before the end
        self.cameras: CameraRecorder | None = None
        self._pictures_fault: str | None = None
        super().__init__(parent, name, room)
        if pictures:
            try:
                self.cameras = CameraRecorder(self._write_picture)
            except OSError as error:
                self._check_cameras(reason_of(error))

    def prepare(self, plant: MujocoPlant, robot: Robot, cameras: Mapping[str, CameraConfig]) -> None:
        """Make ready to take pictures of a run of ``plant``, just before :meth:`begin`; some seconds at most."""
        if self.cameras is not None:
            topics = run_topics(tuple(robot.arms), tuple(robot.joint_names), tuple(cameras))
            self.cameras.prepare(plant, cameras, topics, waits=self._waits)
            self._check_cameras()

    def begin(self, about: About, robot: Robot, topic_rate: float | None = TOPIC_RATE) -> None:
        """Begin the file of a run of ``robot``, with standard topics at ``topic_rate`` [Hz]; None: at every tick."""
        topics = about.topics()
        if self._open(about, RecordedRobot.of(robot), tuple(topics.values()), topic_rate):
            self._packer, self._epoch = TickPacker(about.arms, about.joints), about.epoch

    def __call__(self, tick: Tick) -> None:
        number, self._count = self._count, self._count + 1
        if self.fault is not None or self._packer is None:
            return
        try:
            self._batch.append(self._packer.pack(number, tick))
            if len(self._batch) >= _BATCH:
                self._send_batch()
                self._watch_backlog(tick.now)
        except Exception as error:  # the arms move on, whatever it is
            self._check(reason_of(error))
        if self.cameras is not None:
            try:
                self.cameras.take_pictures(number, tick, self._epoch, wait=self._waits)
            except Exception as error:  # ticks are recorded all the same
                self._check_cameras(reason_of(error))
            self._check_cameras()

    def _send_batch(self) -> None:
        """Send all ticks that wait; those for which there is no room are lost."""
        batch, self._batch = self._batch, []
        if batch and not self._send(batch, wait=self._waits) and self._packer is not None:
            self.overflows += len(batch)
            self._packer.repeat_state()

    def _watch_backlog(self, now: float) -> None:
        """Say it when the file is long behind the run, which a kill of the writer would cost; simulated time waits."""
        if self._waits:
            return
        self._sent.append((self._count - self.overflows, now))
        while len(self._sent) > 1 and self._sent[0][0] <= self.written.ticks:
            self._sent.popleft()
        behind = now - self._sent[0][1]
        self._longest_backlog = max(self._longest_backlog, behind)
        if behind > _BEHIND and not self._said_so:
            what = "its writer gets too little of the processors; killed, it would cost as much"
            _logger.warning("the recording is %.1f s behind the run: %s", behind, what)
        self._said_so = behind > (_CAUGHT_UP if self._said_so else _BEHIND)

    def _write_picture(self, picture: Message) -> None:
        """Called in the thread that hears of the cameras, which may wait for room."""
        if self.writer is not None:
            self.writer.send([picture], picture.size, wait=True)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._send_batch()
        if self.cameras is not None:
            self.cameras.finish(0.0 if self.fault else PATIENCE)
            self._check_cameras()
        self.finish(Conclusion(self.success, None if error is None else reason_of(error)[:_LONGEST_FAULT]))

    @property
    def summary(self) -> RecordingSummary:
        pictures = self.written.messages
        return RecordingSummary(
            file=None if self.file is None else str(self.file),
            ticks=self.written.ticks,
            lost_ticks=self._count - self.written.ticks,
            fault=self.fault,
            pictures=pictures,
            lost_pictures=0 if self.cameras is None else self.cameras.due - pictures,
            pictures_fault=self._pictures_fault,
            longest_backlog_s=self._longest_backlog,
        )

    def _check_cameras(self, fault: str | None = None) -> None:
        """Log the first ``fault``, or one of their process, in one line; no more pictures are taken."""
        if fault is None and self.cameras is not None:
            fault = self.cameras.process.fault
        if fault is not None and self._pictures_fault is None:
            self._pictures_fault = fault
            _logger.warning("no more pictures are recorded, the run goes on: %s", fault)
