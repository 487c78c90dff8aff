"""Renders the pictures of simulated cameras for a recording, in a process of its own.

The loop only copies the joint positions of the simulation.
"""

from __future__ import annotations

import math
import os
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from threading import Event
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from q2r2_control.config.recording import CameraConfig
from q2r2_control.plants.cell_pictures import ENVIRONMENT, jpeg_of, open_cameras
from q2r2_control.process.helper_process import HelperProcess
from q2r2_control.recording.messages import Message, Topic, picture, picture_topic
from q2r2_control.summary.tick import Tick

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco import MujocoPlant

# Total size of the copied positions that may wait for the process [bytes]. In the shipped cell, this is enough for some
# seconds of a camera at 30 Hz.
ROOM = 128 << 10
_NICENESS = 19  # The niceness of this process. The loop and the writer have a higher priority.
_QUALITY = 90  # The JPEG quality of the pictures.
# A picture is already taken if the time until it is due is less than this share of its camera's period. Times are
# rounded, so a picture that is due now may seem to be due a little later.
_ROUNDING = 1e-6
_READY = 10.0  # Longest time to wait before the run until the process is ready [s].


@dataclass(frozen=True)
class CameraSetup:
    """The first request: the model that the pictures show, the cameras, and the channels of their messages."""

    model: bytes  # The pickled mujoco.MjModel that the pictures show.
    cameras: dict[str, CameraConfig]
    channels: dict[str, int]  # The channel of each camera in the file of the recording.
    waited_for: bool  # True if the loop waits for the pictures, as it does in simulated time.


class PictureRequest(NamedTuple):
    """A request for one picture of each of some cameras, at one tick."""

    number: int  # The number of the tick.
    time: int  # The Unix time of the tick [ns].
    cameras: list[str]
    qpos: bytes  # The model's qpos as float64: the positions of all joints and loose bodies.


def main(requests: Iterator[Any], answer: Callable[[Message | None], None]) -> None:
    """Answer None when this process is ready, and then the message of each requested picture.

    Raises :class:`PlantError` if OpenGL is missing.
    """
    setup = next(requests, None)
    if setup is None:
        return
    if not setup.waited_for:
        with suppress(OSError):
            os.nice(_NICENESS)
    cell = open_cameras(setup.model, setup.cameras)
    answer(None)
    for request in requests:
        cell.place(np.frombuffer(request.qpos))
        for name in request.cameras:
            payload = picture(name, request.time, jpeg_of(cell.take(name), _QUALITY))
            answer(Message(setup.channels[name], request.number, request.time, request.time, payload))


class CameraRecorder:
    """Starts the process that takes pictures. :meth:`finish` ends the process."""

    def __init__(self, write: Callable[[Message], None], room: int = ROOM) -> None:
        """Start the process. Another thread calls ``write`` with the message of each picture.

        ``room`` [bytes] is the total size of the copied positions that may wait. Raises :class:`OSError`.
        """
        self._write, self._ready = write, Event()
        self.process = HelperProcess(
            "takes pictures",
            "q2r2_control.recording.camera_recorder",
            self._on_answer,
            room,
            idle=None,
            **ENVIRONMENT,
        )
        self.due = 0  # The number of pictures that were due up to now.
        self._plant: MujocoPlant | None = None  # The simulation; None before :meth:`prepare`.
        self._rates: dict[str, float] = {}  # The rates of the cameras [Hz].
        self._last: dict[str, int] = {}  # The number of each camera's last picture.
        self._next = -math.inf  # The time since the start of the run at which the next picture is due [s].

    def _on_answer(self, picture: Message | None) -> None:
        if picture is not None:
            self._write(picture)
        else:
            self._ready.set()

    def prepare(
        self, plant: MujocoPlant, cameras: Mapping[str, CameraConfig], topics: Mapping[str, Topic], *, waits: bool
    ) -> None:
        """Prepare to take pictures of ``plant``, and wait until the process is ready, at most 10 s.

        ``topics`` are the recording's topics by name. They contain the channel of each camera's messages.

        If ``waits`` is True, the loop will wait for pictures, so their process has the same priority as the loop.
        """
        channels = {name: topics[picture_topic(name)].channel for name in cameras}
        self.process.send(CameraSetup(pickle.dumps(plant.model), dict(cameras), channels, waits))
        waited = 0.0
        while self.process.alive and waited < _READY and not self._ready.wait(0.1):
            waited += 0.1
        self._plant, self._last = plant, dict.fromkeys(cameras, -1)
        self._rates = {name: camera.rate for name, camera in cameras.items()}

    def take_pictures(self, number: int, tick: Tick, epoch: int, *, wait: bool) -> None:
        """Request the pictures that are due at tick ``number`` of a run that began at ``epoch`` [ns]."""
        since = tick.now - tick.start.now
        if self._plant is None or since < self._next:
            return
        # Picture k is due at k / rate.
        newest = {name: math.floor(since * rate + _ROUNDING) for name, rate in self._rates.items()}
        chosen = [name for name, number_of in newest.items() if number_of > self._last[name]]
        request = PictureRequest(number, epoch + round(since * 1e9), chosen, self._plant.observed_qpos.tobytes())
        self.process.send(request, len(request.qpos), wait=wait)
        self.due += sum(newest.values()) - sum(self._last.values())
        self._last = newest
        self._next = min((last + 1 - _ROUNDING) / self._rates[name] for name, last in newest.items())

    def finish(self, patience: float) -> None:
        """Wait until the process has taken all requested pictures. Kill it if it does nothing for ``patience`` [s]."""
        if self._plant is not None and patience > 0.0:
            self.process.finish(patience)
        else:
            self.process.kill()
