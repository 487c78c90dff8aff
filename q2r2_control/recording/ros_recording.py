"""A recording of the ROS nodes, read as if one loop had made it, so that whoever reads recordings reads it as well."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from q2r2_control.config.cell import parse_config
from q2r2_control.config.external import ControllerKind
from q2r2_control.errors import RecordingError
from q2r2_control.recording import topics as names
from q2r2_control.recording.about import ROS
from q2r2_control.recording.reader import Picture, RecordedChunk, Recording, messages_in
from q2r2_control.recording.recorded_robot import cell_and_robot_of
from q2r2_control.recording.ros_ticks import Message, RosTicks
from q2r2_control.recording.ros_topics import is_compressed
from q2r2_control.recording.rows import HEAD, jpeg_of


def open_recording(path: Path) -> Recording:
    """A recording, whatever was recorded. Raises :class:`RecordingError`, see :class:`Recording`."""
    recording = Recording(path)
    return RosRecording(path) if recording.about.source == ROS else recording


class RosRecording(Recording):
    """Raises :class:`RecordingError` for any other recording, and where another controller moved the arms."""

    def chunks(self) -> Iterator[RecordedChunk]:
        """See :meth:`Recording.chunks`."""
        config, robot = cell_and_robot_of(self)
        if config.controller is not ControllerKind.BUILTIN:
            raise RecordingError(
                f"{self.file}: recorded with controller: {config.controller}, so there is no reference of the built-in "
                "controller to judge or export; ros2 bag, Foxglove and mcap tools open it"
            )
        ticks = RosTicks(self.about, self.topics, robot)
        previous: RecordedChunk | None = None
        with self._faults():
            for data in self._chunk_data():
                chunk = ticks.take(self._messages(data))
                if names.TICK in chunk.rows:
                    if previous is not None:
                        yield previous
                    previous = chunk
        if previous is not None and self.closed:  # the recorder was told to end, and the last tick is the run's
            labels = self.topics.by_name[names.TICK].labels["data"]
            previous.rows[names.TICK]["data"][-1, labels.index("following")] = 0.0
        yield ticks.rest(previous)

    def pictures(self, camera: str) -> Iterator[Picture]:
        """See :meth:`Recording.pictures`; of the time at which they were received."""
        topic = parse_config(self.about.cell, f"{self.file}: its cell").cameras[camera].topic or ""
        if not is_compressed(topic):
            raise RecordingError(
                f"{self.file}: pictures of camera {camera} are sensor_msgs/Image on {topic}; allowed to export: "
                "CompressedImage; --no-pictures leaves them out"
            )
        with self._faults():
            for data in self._chunk_data():
                for channel, at, end in messages_in(data):
                    if self.declared_topics[channel].name == topic:
                        _, _, _, number, time, _ = HEAD.unpack_from(data, at)
                        yield Picture(time, number, jpeg_of(data[at:end]))

    def _check_topics(self) -> None:
        """Any topic may be in it."""

    def _messages(self, data: bytes) -> Iterator[Message]:
        for channel, at, end in messages_in(data):
            time = HEAD.unpack_from(data, at)[4]
            yield Message(self.declared_topics[channel].name, time, data[at + HEAD.size : end])
