"""Follows the real cameras of a run, and records their pictures with the times of capture on the loop's clock."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from q2r2_control.cameras.camera_process import CameraShot, DepthShot
from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.cameras.camera_watch import CameraWatch
from q2r2_control.cameras.loop_times import LoopTimes, TickTime
from q2r2_control.cameras.reasons import CameraReason
from q2r2_control.events import Reason
from q2r2_control.recording.about import About
from q2r2_control.recording.messages import JPEG, NANOSECONDS, CodedPicture, coding_of_depth, depth_topic, picture_topic
from q2r2_control.recording.recorder import Recorder
from q2r2_control.summary.tick import Tick
from q2r2_control.wording import sentence

_LAST_PICTURES = 10.0  # Longest wait, at the end of a run, for pictures that were captured during the run [s].
_logger = logging.getLogger(__name__)


class DevicePictures(AbstractContextManager["DevicePictures"]):
    """Watches the real cameras of one run, and records their pictures if the run is recorded.

    It is a listener of the run's pipeline, and a context manager around the run. It never waits while the run goes on.
    """

    def __init__(
        self,
        streams: CameraStreams,
        realtime: bool,
        report: Callable[[Reason], None],
        recording: tuple[Recorder, About] | None = None,
    ) -> None:
        """Follow the open cameras of a run.

        Args:
            streams: The open cameras.
            realtime: True if the loop uses the computer's clock; False in simulated time.
            report: Called with each event of a camera, for example a stop, which the operator and the episode get.
            recording: The recorder of the run and the facts about it; None if the run is not recorded.
        """
        self._streams, self._realtime, self._report = streams.streams, realtime, report
        self._recording = recording
        topics = {} if recording is None else recording[1].topics()
        self._channels = {name: topic.channel for name, topic in topics.items()}
        self._times = LoopTimes()
        self._watches: dict[str, CameraWatch] = {}
        self._before: dict[str, CameraShot] = {}  # Each camera's newest picture before the first tick.
        self._depth_before: dict[str, DepthShot] = {}
        self._count = 0
        self._begin = 0.0  # Time of the first tick, by the monotonic clock [s].
        self._start = 0.0  # Time of the run's start, by the loop's clock [s].
        self._end = 0.0  # Time of the newest tick, by the monotonic clock [s].

    def __call__(self, tick: Tick) -> None:
        now = tick.now if self._realtime else time.monotonic()
        if not self._watches:
            self._start, self._begin = tick.start.now, now
            self._watches = {name: CameraWatch(name, it.camera, now) for name, it in self._streams.items()}
        self._times.add(TickTime(now, tick.now, self._count))
        self._count, self._end = self._count + 1, now
        for name, stream in self._streams.items():
            self._take(name)
            self._tell(self._watches[name].look(now, stream.why_lost))

    def __exit__(self, *_: object) -> None:
        """Wait for the pictures that were captured during the run and have not come yet, and record them."""
        for name, watch in self._watches.items():
            if self._recording is not None and not watch.stopped:
                self._streams[name].wait_for_pictures_until(self._end, _LAST_PICTURES)
            self._take(name, self._end)
            watch.finish(self._end)
        if self._recording is not None:
            self._recording[0].missing_pictures += sum(watch.missing for watch in self._watches.values())

    def _take(self, name: str, until: float = math.inf) -> None:
        """Take a camera's pictures since the last call. Record those captured from the first tick to ``until`` [s].

        The last picture before the first tick is recorded too, because it is the newest picture at that tick.
        """
        for received, shot in self._streams[name].take():
            if shot.time < self._begin:
                self._before[name] = shot
            elif shot.time <= until:
                if (before := self._before.pop(name, None)) is not None:
                    self._record(name, before)
                self._record(name, shot)
                self._tell(self._watches[name].add(shot.time, received, shot.width, shot.height))
        for depth in self._streams[name].take_depths():
            if depth.time < self._begin:
                self._depth_before[name] = depth
            elif depth.time <= until:
                if (earlier := self._depth_before.pop(name, None)) is not None:
                    self._record_depth(name, earlier)
                self._record_depth(name, depth)

    def _record(self, name: str, shot: CameraShot) -> None:
        self._record_data(picture_topic(name), name, shot.time, shot.jpeg)

    def _record_depth(self, name: str, shot: DepthShot) -> None:
        self._record_data(depth_topic(name), name, shot.time, shot.png, coding_of_depth(shot.unit))

    def _record_data(self, topic: str, name: str, time: float, data: bytes, coding: str = JPEG) -> None:
        if self._recording is None:
            return
        (recorder, about), at = self._recording, self._times.at(time)
        stamp = about.epoch + round((at.loop - self._start) * NANOSECONDS)
        recorder.record_picture(CodedPicture(self._channels[topic], at.number, stamp, name, data, coding))

    def _tell(self, reasons: list[Reason]) -> None:
        for reason in reasons:
            _logger.log(logging.INFO if reason.kind is CameraReason.CAMERA_BACK else logging.WARNING, sentence(reason))
            self._report(reason)
