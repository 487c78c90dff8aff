"""Adds the pictures of real cameras to a recorded run, each with the time of its capture on the loop's clock."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import NamedTuple

from q2r2_control.cameras.camera_process import CameraShot
from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.cameras.camera_watch import CameraWatch
from q2r2_control.cameras.reasons import CameraReason
from q2r2_control.events import Reason
from q2r2_control.recording.about import About
from q2r2_control.recording.messages import NANOSECONDS, JpegPicture, picture_topic
from q2r2_control.recording.recorder import Recorder
from q2r2_control.summary.tick import Tick
from q2r2_control.wording import sentence

_KEPT = 8192  # Number of ticks whose times are known: 8 s of a loop at 1 kHz.
_LAST_PICTURES = 10.0  # Longest time at the end of a run to wait for pictures that were captured in it [s].
_logger = logging.getLogger(__name__)


class TickTime(NamedTuple):
    computer: float  # By the monotonic clock [s].
    loop: float  # By the loop's clock [s].
    number: int


class LoopTimes:
    """Converts times of the computer's monotonic clock into times of the loop's clock.

    In real time both are the same. In simulated time, a loop that is paced may be slower than the computer's clock, and
    takes its ticks in bursts.
    """

    def __init__(self) -> None:
        self._ticks: deque[TickTime] = deque(maxlen=_KEPT)

    def add(self, tick: TickTime) -> None:
        self._ticks.append(tick)

    def at(self, computer: float) -> TickTime:
        """Return the loop's time at a time of the computer's clock, with the number of the last tick up to then.

        Before the first tick, the loop's time passes as the computer's, and the number is that of the first tick.
        """
        ahead = None
        for tick in reversed(self._ticks):
            if tick.computer <= computer:
                passed = computer - tick.computer
                longest = passed if ahead is None else ahead.loop - tick.loop
                return TickTime(computer, tick.loop + min(passed, longest), tick.number)
            ahead = tick
        first = self._ticks[0]
        return TickTime(computer, first.loop - (first.computer - computer), first.number)


class DevicePictures(AbstractContextManager["DevicePictures"]):
    """A listener of one recorded run, as a context around it. It never waits while the run goes on."""

    def __init__(
        self, streams: CameraStreams, recorder: Recorder, about: About, report: Callable[[Reason], None]
    ) -> None:
        """``report`` gets what happens to the cameras, for the episode and its operator."""
        self._streams, self._recorder, self._report = streams.streams, recorder, report
        self._epoch, self._realtime = about.epoch, about.realtime
        topics = about.topics()
        self._channels = {name: topics[picture_topic(name)].channel for name in self._streams}
        self._times = LoopTimes()
        self._watches: dict[str, CameraWatch] = {}
        self._before: dict[str, CameraShot] = {}  # The newest pictures before the first tick.
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
        """Add the pictures that were captured in the run and have not come yet."""
        for name, watch in self._watches.items():
            if not watch.stopped:
                self._streams[name].wait_for_pictures_until(self._end, _LAST_PICTURES)
            self._take(name, self._end)
            watch.finish(self._end)
        self._recorder.missing_pictures += sum(watch.missing for watch in self._watches.values())

    def _take(self, name: str, until: float = math.inf) -> None:
        """Record the pictures of a camera since the last call that were captured in the run, ``until`` a time [s].

        The last picture before the run is recorded too, because it is the newest one at the first tick.
        """
        for received, shot in self._streams[name].take():
            if shot.time < self._begin:
                self._before[name] = shot
            elif shot.time <= until:
                if (before := self._before.pop(name, None)) is not None:
                    self._record(name, before)
                self._record(name, shot)
                self._tell(self._watches[name].add(shot.time, received, shot.width, shot.height))

    def _record(self, name: str, shot: CameraShot) -> None:
        at = self._times.at(shot.time)
        stamp = self._epoch + round((at.loop - self._start) * NANOSECONDS)
        self._recorder.record_picture(JpegPicture(self._channels[name], at.number, stamp, name, shot.jpeg))

    def _tell(self, reasons: list[Reason]) -> None:
        for reason in reasons:
            _logger.log(logging.INFO if reason.kind is CameraReason.CAMERA_BACK else logging.WARNING, sentence(reason))
            self._report(reason)
