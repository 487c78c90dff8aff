"""Pictures of one camera for spectators.

A process of its own takes the pictures of a simulated camera. The pictures of a real camera come from its stream.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from q2r2_control.config.recording import CameraConfig
from q2r2_control.plants.cell_pictures import ENVIRONMENT, jpeg_of, open_cameras
from q2r2_control.process.helper_process import HelperProcess
from q2r2_control.summary.tick import Tick

if TYPE_CHECKING:
    from q2r2_control.cameras.camera_process import CameraShot
    from q2r2_control.plants.mujoco import MujocoPlant

_NICENESS = 19  # The process gets the lowest priority, since the loop and the hands come first.
_QUALITY = 70  # JPEG quality, from 0 to 100.
_logger = logging.getLogger(__name__)


class PictureSetup(NamedTuple):
    """The first request to the process that takes pictures."""

    model: bytes  # A pickled mujoco.MjModel.
    name: str  # Name of the camera.
    camera: CameraConfig


def main(requests: Iterator[Any], answer: Callable[[bytes], None]) -> None:
    """Run the process. The first request is the setup; each further request is MuJoCo's positions (qpos) as bytes.

    The answer to each further request is a picture as JPEG.
    """
    setup = next(requests, None)
    if setup is None:
        return
    with suppress(OSError):
        os.nice(_NICENESS)
    cell = open_cameras(setup.model, {setup.name: setup.camera})
    for qpos in requests:
        cell.place(np.frombuffer(qpos))
        answer(jpeg_of(cell.take(setup.name), _QUALITY))


class LivePictures(AbstractContextManager["LivePictures"]):
    """Shows pictures of the simulated cell during one run: a listener of the run, and a context around it.

    If the process fails, one line is logged and the run goes on.
    """

    def __init__(
        self,
        plant: MujocoPlant,
        name: str,
        camera: CameraConfig,
        most: float,
        show: Callable[[bytes], object],
        watched: Callable[[], bool],
    ) -> None:
        """Start the process; raises :class:`OSError` if it cannot be started.

        ``show`` gets up to ``most`` pictures a second in a thread of its own, as long as ``watched`` returns True.
        """
        self._plant, self._period, self._watched = plant, 1.0 / min(camera.rate, most), watched
        self._due = 0.0  # Time of the next picture, by the monotonic clock [s].

        def pass_on(jpeg: bytes) -> None:
            show(jpeg)

        # Only one request may wait, because a newer picture is better than a queue of old ones.
        self._process = HelperProcess("takes pictures", __name__, pass_on, room=1, idle=None, **ENVIRONMENT)
        self._process.send(PictureSetup(pickle.dumps(plant.model), name, camera))
        self._told = False

    def __call__(self, tick: Tick) -> None:
        now = time.monotonic()
        if now >= self._due and self._watched() and self._process.send(self._plant.observed_qpos.tobytes(), 1):
            self._due = now + self._period
        elif not self._process.alive and not self._told:
            self._told = True
            _logger.warning("no more pictures are shown: %s", self._process.fault)

    def __exit__(self, *_: object) -> None:
        self._told = True  # This end is no fault, so no line is due.
        self._process.kill()


class ShownPictures:
    """Shows some of the pictures of a real camera. It is called with each picture of a :class:`CameraStream`."""

    def __init__(self, most: float, show: Callable[[bytes], object], watched: Callable[[], bool]) -> None:
        """``show`` gets up to ``most`` pictures a second, as long as ``watched`` returns True."""
        self._period, self._show, self._watched = 1.0 / most, show, watched
        self._due = -math.inf  # Time of the next picture, by the time of capture [s].

    def __call__(self, shot: CameraShot) -> None:
        if shot.time >= self._due and self._watched():
            self._due = shot.time + self._period
            self._show(shot.jpeg)
