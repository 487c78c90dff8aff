"""A recording of the ROS nodes, read as if one loop had made it, so that whoever reads recordings reads it as well."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from q2r2_control.config.cell import parse_config
from q2r2_control.config.external import ControllerKind
from q2r2_control.errors import RecordingError
from q2r2_control.recording.about import ROS
from q2r2_control.recording.reader import Picture, Recording, TickChunk
from q2r2_control.recording.recorded_robot import cell_and_robot_of
from q2r2_control.recording.ros_ticks import RosTicks
from q2r2_control.recording.ros_topics import is_compressed


def open_recording(path: Path) -> Recording:
    """A recording, whatever was recorded. Raises :class:`RecordingError`, see :class:`Recording`."""
    recording = Recording(path)
    return RosRecording(path) if recording.about.source == ROS else recording


class RosRecording(Recording):
    """Raises :class:`RecordingError` for any other recording, and where another controller moved the arms."""

    def chunks(self) -> Iterator[TickChunk]:
        """See :meth:`Recording.chunks`."""
        config, robot = cell_and_robot_of(self)
        if config.controller is not ControllerKind.BUILTIN:
            raise RecordingError(
                f"{self.file}: recorded with controller: {config.controller}, so there is no reference of the built-in "
                "controller to judge or export; ros2 bag, Foxglove and mcap tools open it"
            )
        ticks = RosTicks(self.about, robot)
        previous: TickChunk | None = None
        for messages in self.messages():
            with self._faults():
                chunk = ticks.take((self.declared_topics[one.channel].name, one) for one in messages)
            if len(chunk.rows):
                if previous is not None:
                    yield previous
                previous = chunk
        if previous is not None and self.closed:  # the recorder was told to end, and the last tick is the run's
            previous.rows["following"][-1] = 0.0
        yield ticks.rest(previous)

    def pictures(self, camera: str) -> Iterator[Picture]:
        """See :meth:`Recording.pictures`; of the time at which they were received."""
        topic = parse_config(self.about.cell, f"{self.file}: its cell").cameras[camera].topic or ""
        if not is_compressed(topic):
            raise RecordingError(
                f"{self.file}: pictures of camera {camera} are sensor_msgs/Image on {topic}; allowed to export: "
                "CompressedImage; --no-pictures leaves them out"
            )
        yield from self._pictures_on(topic)
