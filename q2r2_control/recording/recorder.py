"""Records a run, or messages of ROS nodes, into a new folder. A process of its own writes the file."""

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

from mcap.exceptions import EndOfFile

from q2r2_control.config.recording import TOPIC_RATE, CameraConfig
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.process.folders import new_folder
from q2r2_control.process.helper_process import HelperProcess, reason_of
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.camera_recorder import CameraRecorder
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.messages import CodedPicture, Message, Topic, run_topics
from q2r2_control.recording.reader import BROKEN
from q2r2_control.recording.tick_rows import PackedTick, TickPacker
from q2r2_control.recording.writer import FLUSH_PERIOD, RecordedRobot, RecordingSetup, Written
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason

if TYPE_CHECKING:  # The module is not imported at run time, because the ROS node does not need MuJoCo.
    from q2r2_control.plants.mujoco import MujocoPlant

PATIENCE = 10.0  # Time to wait for a disk that hangs at the end of a run [s].
# Size of the data that may wait to be sent [bytes]. As much data may wait in the writer. A tick of two arms has 1.6 kB,
# and the ROS nodes of two arms send some 0.6 MB a second.
ROOM = 4 << 20
# A warning is logged if the file is behind the run by more than the first time [s]. There is no second warning until
# the file is behind by less than the second time [s].
_BEHIND, _CAUGHT_UP = 2.0, 1.0
# The same as ROOM, for recordings of ROS nodes with pictures [bytes]. An uncompressed picture has a megabyte.
ROOM_WITH_PICTURES = 64 << 20
_LAST_NUMBER = 2**32 - 1
_BATCH = 16  # The number of ticks that are sent together.
_LONGEST_FAULT = 500  # A longer text of the fault that ended a run is cut off [characters].

_logger = logging.getLogger(__name__)


class BaseRecorder:
    """Sends data to a process that writes it into a file.

    It raises no errors: a failure is logged once, and the run goes on.
    """

    def __init__(self, parent: Path, name: str, room: int) -> None:
        """Start the process; ``room`` [bytes] is the size of the data that may wait to be written."""
        self._parent, self._name = parent, name
        self.fault: str | None = None  # The reason why nothing more is recorded; None without a failure.
        self.file: Path | None = None  # The path of the recording; None while there is no file.
        self.written = Written()
        self.writer: HelperProcess | None = None
        self.record_outcome: Callable[[Reason], None] = lambda reason: None  # Called with a failure, for the operator.
        try:
            module = "q2r2_control.recording.writer"
            on_written = partial(setattr, self, "written")
            self.writer = HelperProcess("writes it", module, on_written, room, idle=FLUSH_PERIOD)
        except OSError as error:
            self._check(reason_of(error))

    def _open(
        self, about: About, robot: RecordedRobot | None, topics: tuple[Topic, ...], topic_rate: float | None = None
    ) -> bool:
        """Let the writer begin the file of a run that begins at ``about.epoch``. Return whether that was possible."""
        if self.writer is None:
            return False
        try:
            # The name begins with the date and time. Recordings that are sorted by name are then in the order of time.
            when = datetime.fromtimestamp(about.epoch * 1e-9)
            folder = new_folder(self._parent, f"{when:%Y%m%d-%H%M%S}-{self._name}", "--record")
        except (ConfigError, OSError) as error:
            self._check(reason_of(error))
            return False
        self.file = folder / f"{folder.name}.mcap"
        self.writer.send(RecordingSetup(self.file.absolute(), about, topics, robot, topic_rate))
        return True

    def _send(self, batch: list[PackedTick] | list[Message] | list[CodedPicture], *, wait: bool = False) -> bool:
        """Send a batch to the writer. Return whether it was sent.

        The batch is not sent after a failure, or if too much data waits already. If ``wait`` is True, wait until less
        data waits.
        """
        if self.writer is None or self.fault is not None:
            return False
        sent = self.writer.send(batch, sum(one.size for one in batch), wait=wait)
        self._check()
        return sent

    def finish(self, conclusion: Conclusion | None = None) -> None:
        """Let the writer write the data that waits and the ``conclusion``, and close the file.

        After a failure, a file without messages is removed.
        """
        if self.writer is not None:
            if self.file is not None:
                self.writer.send(conclusion or Conclusion())
            self.writer.finish(PATIENCE)
            self._check()
        if self.fault is not None and self.file is not None and is_empty(self.file):
            with suppress(OSError):
                self.file.unlink(missing_ok=True)
                self.file.parent.rmdir()
            self.file = None

    def _check(self, fault: str | None = None) -> None:
        """Log the first ``fault``, or a fault of the writer, in one line; after a fault nothing more is recorded."""
        if fault is None and self.writer is not None:
            fault = self.writer.fault
        if fault is not None and self.fault is None:
            self.fault = f"{self.file}: {fault}" if self.file is not None else fault
            _logger.warning("recording ended, the run goes on: %s", self.fault)
            self.record_outcome(Reason.of(TeleopReason.RECORDING_ENDED, text=self.fault))


def is_empty(file: Path) -> bool:
    """Return whether a file has no message, for example because it is missing or its writer was killed early."""
    if not file.exists():
        return True
    try:
        return not any(McapFile(file).messages())
    except EndOfFile:  # The file ends within its first message, or before it.
        return True
    except (OSError, *BROKEN):  # The file can contain messages that cannot be read now, so it must not be removed.
        return False


class MessageRecorder(BaseRecorder):
    """Records messages into one file. It never waits: if too much data waits already, messages are lost and counted."""

    def __init__(self, parent: Path, name: str, room: int = ROOM) -> None:
        super().__init__(parent, name, room)
        self.count = self.overflows = 0  # The number of all messages, and of the lost messages.
        self._last = 0  # The Unix time of the newest message [ns].
        self._begun = False

    def begin(self, about: About, topics: tuple[Topic, ...]) -> None:
        self._begun, self._last = self._open(about, None, topics), about.epoch

    def record(self, messages: Iterable[Message]) -> None:
        """Send messages to the writer, in the order of the times at which they were received.

        The times in a file never decrease. A message that is older than the message before gets the time of that
        message.
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
    """The outcome of a recording."""

    file: str | None  # The path of the file; None if no file could be made.
    ticks: int  # The number of ticks that were written.
    lost_ticks: int  # The number of ticks that were not written, because too much data waited or the disk had failed.
    fault: str | None  # The reason why the recording ended before the run; None if it did not.
    pictures: int = 0  # The number of pictures that were written.
    lost_pictures: int = 0  # The number of pictures that were due and are missing.
    pictures_fault: str | None = None  # The reason why no more pictures were taken; None if there was no failure.
    # The longest time by which the file was behind the run. If the writer had been killed, this time would be lost.
    longest_backlog_s: float = 0.0


class Recorder(BaseRecorder, AbstractContextManager["Recorder"]):
    """Records one run. It is a listener of the run's pipeline, and a context manager around the run.

    It raises no errors: a failure is logged once, and the run goes on.

    The constructor starts the process of the writer. Make the recorder before any long preparation, and call
    :meth:`begin` just before the run begins::

        with Recorder(Path("recordings"), "reach", waits=True) as recorder:
            recorder.begin(About.of(pipeline, False, {"task": "reach for the cup"}), pipeline.robot)
            pipeline.listeners.append(recorder)
            pipeline.run(5.0, realtime=False)
    """

    keeps_episodes = True  # The operator can mark where an episode begins and ends.

    def __init__(
        self, parent: Path, name: str, *, waits: bool = False, room: int = ROOM, pictures: bool = False
    ) -> None:
        """Start the process of the writer.

        Args:
            parent: The folder in which the recording gets a folder of its own.
            name: The last part of the names of that folder and of the file. The first part is the date and time.
            waits: What happens if the data that waits to be written is larger than ``room``. If True, the run waits,
                which is allowed in simulated time. If False, ticks are lost and counted.
            room: The size of the data that may wait to be written [bytes].
            pictures: True to start one more process, which takes the pictures of the cameras of :meth:`prepare`.
        """
        self._waits = waits
        self._count = 0  # The number of ticks so far.
        self.overflows = 0  # The number of ticks that were lost because too much data waited.
        self._packer: TickPacker | None = None  # Packs the ticks; None before :meth:`begin`.
        self._batch: list[PackedTick] = []
        # For each batch that is not yet written, the number of ticks up to its end, and the loop's time at its end [s].
        self._sent: deque[tuple[int, float]] = deque()
        self._longest_backlog, self._said_so = 0.0, False
        self._epoch = 0
        # Whether the run succeeded. If the task has a check of its own, its result is set here before the run ends.
        self.success: bool | None = None
        self.cameras: CameraRecorder | None = None
        self._pictures_fault: str | None = None
        # For real cameras, the number of pictures that came, and the number that were due and did not come.
        self.device_pictures = self.missing_pictures = 0
        super().__init__(parent, name, room)
        if pictures:
            try:
                self.cameras = CameraRecorder(self._write_picture)
            except OSError as error:
                self._check_cameras(reason_of(error))

    def prepare(self, plant: MujocoPlant, robot: Robot, cameras: Mapping[str, CameraConfig]) -> None:
        """Prepare to take pictures of ``plant``. Call it just before :meth:`begin`. It takes at most ten seconds.

        Args:
            plant: The simulation that moves the arms.
            robot: The robot of the run.
            cameras: The cell's ``simulated_cameras``, by name.
        """
        if self.cameras is not None:
            topics = run_topics(tuple(robot.arms), tuple(robot.joint_names), tuple(cameras))
            self.cameras.prepare(plant, cameras, topics, waits=self._waits)
            self._check_cameras()

    def begin(self, about: About, robot: Robot, topic_rate: float | None = TOPIC_RATE) -> None:
        """Begin the file of a run. From now on the recorder may be called, as a listener of the run's pipeline.

        Args:
            about: The facts that the run states at its beginning.
            robot: The robot of the run.
            topic_rate: The rate of the standard topics, which repeat numbers of the tick [Hz]; None for every tick.
        """
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
        except Exception as error:  # An error of the recorder must not stop the arms.
            self._check(reason_of(error))
        if self.cameras is not None:
            try:
                self.cameras.take_pictures(number, tick, self._epoch, wait=self._waits)
            except Exception as error:  # After an error of the cameras, ticks are still recorded.
                self._check_cameras(reason_of(error))
            self._check_cameras()

    def _send_batch(self) -> None:
        """Send all ticks of the batch. They are lost if too much data waits already."""
        batch, self._batch = self._batch, []
        if batch and not self._send(batch, wait=self._waits) and self._packer is not None:
            self.overflows += len(batch)
            self._packer.repeat_state()

    def _watch_backlog(self, now: float) -> None:
        """Warn if the file is far behind the run.

        If the writer were killed, the data that is not yet in the file would be lost. A run in simulated time waits
        for the writer, so no warning is needed.
        """
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
        """Send a picture of a simulated camera to the writer. If too much data waits, first wait until less data waits.

        The thread that receives the pictures calls this method, so the loop need not wait.
        """
        if self.writer is not None:
            self.writer.send([picture], picture.size, wait=True)

    def record_picture(self, picture: CodedPicture) -> None:
        """Send a picture of a real camera to the writer. It is lost and counted if too much data waits already."""
        self.device_pictures += 1
        self._send([picture])

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._send_batch()
        if self.cameras is not None:
            self.cameras.finish(0.0 if self.fault else PATIENCE)
            self._check_cameras()
        self.finish(Conclusion(self.success, None if error is None else reason_of(error)[:_LONGEST_FAULT]))

    @property
    def summary(self) -> RecordingSummary:
        pictures = self.written.messages
        due = self.device_pictures + self.missing_pictures + (0 if self.cameras is None else self.cameras.due)
        return RecordingSummary(
            file=None if self.file is None else str(self.file),
            ticks=self.written.ticks,
            lost_ticks=self._count - self.written.ticks,
            fault=self.fault,
            pictures=pictures,
            lost_pictures=due - pictures,
            pictures_fault=self._pictures_fault,
            longest_backlog_s=self._longest_backlog,
        )

    def _check_cameras(self, fault: str | None = None) -> None:
        """Log the first ``fault``, or a fault of the process, in one line; after a fault no more pictures are taken."""
        if fault is None and self.cameras is not None:
            fault = self.cameras.process.fault
        if fault is not None and self._pictures_fault is None:
            self._pictures_fault = fault
            _logger.warning("no more pictures are recorded, the run goes on: %s", fault)
