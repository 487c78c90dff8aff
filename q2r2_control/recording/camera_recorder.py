"""Takes the pictures of a recording in a process of its own; the loop only copies where everything is."""

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

ROOM = 128 << 10  # for copies that wait [bytes]; of the shipped cell, some seconds of a camera at 30 Hz
_NICENESS = 19  # loop and writer go first
_QUALITY = 90  # of JPEG
_ROUNDING = 1e-6  # of a period: a picture that is due but for the rounding of times is due
_READY = 10.0  # for the process to be ready, before the run [s]


@dataclass(frozen=True)
class CameraSetup:
    """The first request: what pictures are taken of and where they go."""

    model: bytes  # an mujoco.MjModel, pickled
    cameras: dict[str, CameraConfig]
    channels: dict[str, int]  # of the recording's file
    waited_for: bool  # by the loop, in simulated time


class PictureRequest(NamedTuple):
    number: int  # of the tick
    time: int  # of day [ns]
    cameras: list[str]
    qpos: bytes  # float64, where everything is


def main(requests: Iterator[Any], answer: Callable[[Message | None], None]) -> None:
    """Answer None when ready, then each picture's message. Raises :class:`PlantError` where OpenGL is missing."""
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
    """Its process starts at once. To be ended by :meth:`finish`."""

    def __init__(self, write: Callable[[Message], None], room: int = ROOM) -> None:
        """``write`` gets the message of each picture, in another thread; ``room`` [bytes] is for copies that wait.

        Raises :class:`OSError`.
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

    def prepare(
        self, plant: MujocoPlant, cameras: Mapping[str, CameraConfig], topics: Mapping[str, Topic], *, waits: bool
    ) -> None:
        """Make ready for pictures of ``plant``, for messages of ``topics``; waits for that, some seconds at most.

        ``waits``: the loop will wait for pictures, so they are as urgent as the loop.
        """
        channels = {name: topics[picture_topic(name)].channel for name in cameras}
        self.process.send(CameraSetup(pickle.dumps(plant.model), dict(cameras), channels, waits))
        waited = 0.0
        while self.process.alive and waited < _READY and not self._ready.wait(0.1):
            waited += 0.1
        self._plant, self._last = plant, dict.fromkeys(cameras, -1)
        self._rates = {name: camera.rate for name, camera in cameras.items()}

    def take_pictures(self, number: int, tick: Tick, epoch: int, *, wait: bool) -> None:
        """Have pictures taken that are due at the ``number``-th tick of a run from ``epoch`` [ns] on."""
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
        """Let it take the pictures that wait; one that does nothing for ``patience`` [s] is killed."""
        if self._plant is not None and patience > 0.0:
            self.process.finish(patience)
        else:
            self.process.kill()
