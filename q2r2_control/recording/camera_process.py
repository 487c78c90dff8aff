"""The process that takes the pictures of a recording, as the run sees it.

The loop only copies where everything is, and that at ticks at which a picture is due. Pictures are taken of those
copies whenever there is time: what waits are copies, which are small.
"""

from __future__ import annotations

import math
import os
import pickle
import time
from collections.abc import Mapping

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.camera_work import COPY_HEAD, CameraSetup
from q2r2_control.recording.helper_process import HelperProcess
from q2r2_control.recording.picture_channel import PictureChannel
from q2r2_control.recording.ring import Ring, new_memory
from q2r2_control.recording.topics import Topics, picture
from q2r2_control.summary.tick import Tick

ROOM = 128 << 10  # for copies that wait [bytes]; of the shipped cell, some seconds of a camera at 30 Hz
_ROUNDING = 1e-6  # of a period: what is due but for the rounding of times is due
_READY = 10.0  # for the process to be ready, before the run [s]


class CameraProcess:
    """Begins with its imports at once. To be ended by :meth:`finish`."""

    def __init__(self, channel: PictureChannel, room: int = ROOM) -> None:
        """``room`` [bytes] for copies that wait. Raises :class:`OSError` where there can be no such process."""
        self._setup, states = new_memory(0), new_memory(room)
        self.ring = Ring(states)
        try:
            self._process = HelperProcess(
                "takes pictures",
                "q2r2_control.recording.camera_work",
                (states, self._setup, channel.memory, channel.open),
                lambda: (*self.ring.progress, *channel.ring.progress),
                MUJOCO_GL="egl",  # MuJoCo's own choice needs a display
                LP_NUM_THREADS="1",  # without a graphics card, one processor stays the loop's
            )
        finally:
            os.close(states)
            channel.close()
        self.pid = self._process.pid
        self.due = 0  # pictures that should be there by now
        self._plant: MujocoPlant | None = None  # None: not begun

    def prepare(self, plant: MujocoPlant, cameras: Mapping[str, CameraConfig], topics: Topics) -> None:
        """Make ready for pictures of ``plant``, for messages of ``topics``; waits for that, some seconds at most."""
        channels = {name: topics.by_name[picture(name)].channel for name in cameras}
        with os.fdopen(self._setup, "wb") as stream:
            self._setup = -1
            pickle.dump(CameraSetup(plant.model, dict(cameras), channels), stream)
            stream.flush()
            os.lseek(stream.fileno(), 0, os.SEEK_SET)
            self.ring.put(b"")
            self.ring.finish()
            until = time.monotonic() + _READY
            while not any(self.ring.progress) and self._process.alive and time.monotonic() < until:
                time.sleep(0.01)
        self._plant = plant
        self._rates = [camera.rate for camera in cameras.values()]
        self._last = [-1] * len(cameras)  # number of each one's last picture
        self._next = -math.inf  # when a picture is due, since the start of the run [s]

    def take(self, number: int, tick: Tick, epoch: int) -> bool:
        """Have those pictures taken that are due at a tick, the ``number``-th; False where there is no room now.

        ``epoch``: time of day at which the run began [ns].
        """
        since = tick.now - tick.start.now
        if self._plant is None or since < self._next:
            return True
        chosen = sum(1 << at for at, newest in enumerate(self._newest(since)) if newest > self._last[at])
        head = COPY_HEAD.pack(number, epoch + round(since * 1e9), chosen)
        if not self.ring.put(head + self._plant.observed_qpos.tobytes()):
            return False
        self.skip(tick)
        return True

    def skip(self, tick: Tick) -> None:
        """Count what is due at a tick, whether it is taken or not."""
        if self._plant is not None:
            newest = self._newest(tick.now - tick.start.now)
            self.due += sum(newest) - sum(self._last)
            self._last = newest
            pairs = zip(newest, self._rates, strict=True)
            self._next = min((number + 1 - _ROUNDING) / rate for number, rate in pairs)

    def _newest(self, since: float) -> list[int]:
        """Number of the newest picture that each camera should have taken by then; k is due at k / rate."""
        return [math.floor(since * rate + _ROUNDING) for rate in self._rates]

    def fault(self) -> str | None:
        """Why it has ended before it was told to; None while it has not. Does not wait."""
        return self._process.fault()

    def finish(self, patience: float) -> str | None:
        """Let it take the pictures that wait, and end. Returns why it did not, or None.

        One that gets nowhere for ``patience`` [s] is killed, and one that has not begun at once.
        """
        fault = None
        if self._plant is not None and patience > 0.0:
            self.ring.finish()
            fault = self._process.last_words(patience, f"no picture was taken for {patience:g} s")
        self._process.end()
        if self._setup >= 0:
            os.close(self._setup)
        return fault
