"""Takes the pictures of a recording, in a process of its own.

The loop only copies where everything is, and that at ticks at which a picture is due. Pictures are drawn of those
copies whenever there is time, since copies are small and may wait.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Mapping
from threading import Event

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.camera_process import CameraSetup, PictureRequest
from q2r2_control.recording.helper_process import HelperProcess
from q2r2_control.recording.messages import Message
from q2r2_control.recording.topics import Topic, picture_topic
from q2r2_control.summary.tick import Tick

ROOM = 128 << 10  # for copies that wait [bytes]; of the shipped cell, some seconds of a camera at 30 Hz
_ROUNDING = 1e-6  # of a period: what is due but for the rounding of times is due
_READY = 10.0  # for the process to be ready, before the run [s]


class CameraRecorder:
    """Its process begins with its imports at once. To be ended by :meth:`finish`."""

    def __init__(self, write: Callable[[Message], None], room: int = ROOM) -> None:
        """``write`` gets the message of each picture, in another thread; ``room`` [bytes] is for copies that wait.

        Raises :class:`OSError` where there can be no such process.
        """
        self._write, self._ready = write, Event()
        self._process = HelperProcess(
            "takes pictures",
            "q2r2_control.recording.camera_process",
            self._on_answer,
            room,
            MUJOCO_GL="egl",  # MuJoCo's own choice needs a display
            LP_NUM_THREADS="1",  # without a graphics card, one processor stays the loop's
        )
        self.pid = self._process.pid
        self.due = 0  # pictures that should be there by now
        self._plant: MujocoPlant | None = None  # None: not begun
        self._rates: dict[str, float] = {}  # of the cameras [Hz]
        self._last: dict[str, int] = {}  # number of each one's last picture
        self._next = -math.inf  # when a picture is due, since the start of the run [s]

    def _on_answer(self, picture: Message | None) -> None:
        if picture is not None:
            self._write(picture)
        else:
            self._ready.set()

    @property
    def fault(self) -> str | None:
        """Why no more pictures are taken."""
        return self._process.fault

    def prepare(self, plant: MujocoPlant, cameras: Mapping[str, CameraConfig], topics: Mapping[str, Topic]) -> None:
        """Make ready for pictures of ``plant``, for messages of ``topics``; waits for that, some seconds at most."""
        channels = {name: topics[picture_topic(name)].channel for name in cameras}
        self._process.send(CameraSetup(pickle.dumps(plant.model), dict(cameras), channels))
        waited = 0.0
        while self._process.alive and waited < _READY and not self._ready.wait(0.1):
            waited += 0.1
        self._plant, self._last = plant, dict.fromkeys(cameras, -1)
        self._rates = {name: camera.rate for name, camera in cameras.items()}

    def take_pictures(self, number: int, tick: Tick, epoch: int, *, wait: bool) -> None:
        """Have those pictures taken that are due at a tick, the ``number``-th; ``wait`` for room, or lose them.

        ``epoch``: time of day at which the run began [ns].
        """
        since = tick.now - tick.start.now
        if self._plant is None or since < self._next:
            return
        # Picture k is due at k / rate.
        newest = {name: math.floor(since * rate + _ROUNDING) for name, rate in self._rates.items()}
        chosen = [name for name, number_of in newest.items() if number_of > self._last[name]]
        request = PictureRequest(number, epoch + round(since * 1e9), chosen, self._plant.observed_qpos.tobytes())
        self._process.send(request, len(request.qpos), wait=wait)
        self.due += sum(newest.values()) - sum(self._last.values())
        self._last = newest
        self._next = min((last + 1 - _ROUNDING) / self._rates[name] for name, last in newest.items())

    def finish(self, patience: float) -> None:
        """Let it take the pictures that wait, and end.

        One that does nothing for ``patience`` [s] is killed, and one that has not begun at once.
        """
        if self._plant is not None and patience > 0.0:
            self._process.finish(patience)
        else:
            self._process.kill()
