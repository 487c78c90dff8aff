"""Makes messages from the pictures of real cameras for a recording of the ROS nodes, and reports stopped cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.cameras.camera_watch import CameraWatch
from q2r2_control.events import Reason
from q2r2_control.recording.messages import CodedPicture, Message, coding_of_depth, depth_topic, picture_topic


@dataclass(slots=True)
class DeviceMessages:
    """Takes the pictures of a recording's open cameras. Times are by the monotonic clock."""

    streams: CameraStreams
    channels: Mapping[str, int]  # The channel of each topic's messages.
    day: Callable[[float], int]  # Converts a time [s] to the Unix time [ns].
    begin: float  # Time at which the recording begins [s].
    _watches: dict[str, CameraWatch] = field(init=False)
    _numbers: dict[str, int] = field(init=False)  # The number of each camera's pictures so far.

    def __post_init__(self) -> None:
        streams = self.streams.streams
        self._watches = {name: CameraWatch(name, stream.camera, self.begin) for name, stream in streams.items()}
        self._numbers = dict.fromkeys(streams, 0)

    def take(self, now: float) -> tuple[list[Message], list[Reason]]:
        """Return the messages of all pictures since the last call, and the events of cameras, such as a stop.

        In a message, ``sent`` is the Unix time at which its picture was captured. ``time`` is the Unix time at which
        the picture was received. For a picture of depth, ``time`` is the Unix time of this call, which is made at
        ``now`` [s]. The file's messages are in the order of ``time``.
        """
        messages, reasons = [], []
        for name, stream in self.streams.streams.items():
            watch = self._watches[name]
            for received, shot in stream.take():
                if shot.time >= self.begin:
                    self._numbers[name] += 1
                    number, captured = self._numbers[name], self.day(shot.time)
                    channel = self.channels[picture_topic(name)]
                    message = CodedPicture(channel, number, captured, name, shot.jpeg).message()
                    messages.append(message._replace(time=self.day(received)))
                    reasons += watch.add(shot.time, received, shot.width, shot.height)
            reasons += watch.look(now, stream.why_lost)
            for depth in stream.take_depths():
                if depth.time >= self.begin:
                    channel, coding = self.channels[depth_topic(name)], coding_of_depth(depth.unit)
                    message = CodedPicture(channel, 0, self.day(depth.time), name, depth.png, coding).message()
                    messages.append(message._replace(time=self.day(now)))
        return messages, reasons
