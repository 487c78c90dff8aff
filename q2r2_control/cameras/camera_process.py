"""The process that reads one camera. Each camera has such a process, so a slow camera delays nothing else."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.cameras.device import CameraDevice, DepthCapture, Pixels
from q2r2_control.cameras.opening import open_device
from q2r2_control.config.recording import CameraConfig
from q2r2_control.process.helper_process import reason_of

# Niceness of a camera's process. At this niceness, the loop has priority even over ten of these processes together.
# On a computer that is too busy, this process may therefore receive a picture late. If the picture has no stamp of the
# driver, its time is the time of its receipt, and is then late too.
_NICENESS = 15
_QUALITY = 90  # The quality of JPEG pictures, from 0 to 100.
_RETRY = 0.5  # Time between two attempts to open a camera that was lost [s].
_EARLY = 0.4  # A picture that comes before it is due is kept if it is early by at most this share of a period.


class CameraShot(NamedTuple):
    """A picture of a camera."""

    time: float  # Time of its capture, by the monotonic clock [s].
    width: int  # [pixels]
    height: int  # [pixels]
    jpeg: bytes


class DepthShot(NamedTuple):
    """A picture of the depth that a camera sees."""

    time: float  # Time of its capture, by the monotonic clock [s].
    png: bytes  # A 16-bit number for each pixel: the depth in multiples of ``unit``; 0 where it is not known.
    unit: float  # The depth that the number 1 means [m].


class CameraLost(NamedTuple):
    """The camera gives no more pictures. If pictures follow, the camera has been opened again."""

    why: str


class Thinning:
    """If a camera gives more pictures than ``rate`` [Hz], leaves out some of them, evenly over time."""

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate
        self._due: float | None = None  # Time at which the next picture is due [s].

    def keeps(self, time: float) -> bool:
        """Return whether the picture that was captured at ``time`` [s] is kept."""
        due = time if self._due is None else self._due
        if time < due - _EARLY * self._period:
            return False
        self._due = max(due, time - _EARLY * self._period) + self._period
        return True


Answer = CameraShot | DepthShot | CameraLost


def main(requests: Iterator[Any], answer: Callable[[Answer], None]) -> None:
    """Send each picture of a camera as an answer until the requests end. The first request is the camera's settings.

    If the camera is lost later, this process tries again and again to open it.

    Raises:
        CameraError: If the camera cannot be opened for the first time.
    """
    camera = next(requests, None)
    if not isinstance(camera, CameraConfig):
        return
    with suppress(OSError):
        os.nice(_NICENESS)
    threading.Thread(target=_end_with, args=(requests,), daemon=True).start()
    device = open_device(camera)
    while True:
        try:
            _pass_on(device, camera, answer)
        except Exception as error:  # Libraries of cameras raise exceptions of their own if a camera is unplugged.
            answer(CameraLost(reason_of(error)))
        with suppress(Exception):  # Closing an unplugged camera can raise an exception.
            device.close()
        if camera.device_kind == "file":
            # A video that has ended does not begin again, so this process only waits until the run ends.
            threading.Event().wait()
        device = _opened_anew(camera)


def _end_with(requests: Iterator[Any]) -> None:
    """End this process when the run ends, even while the process waits for a camera."""
    for _ in requests:
        pass
    os._exit(0)


def _pass_on(device: CameraDevice, camera: CameraConfig, answer: Callable[[Answer], None]) -> None:
    thinning, of_depth = Thinning(camera.rate), Thinning(camera.rate)
    while True:
        captured = device.read()
        if isinstance(captured, DepthCapture):
            if of_depth.keeps(captured.time):
                answer(DepthShot(captured.time, png_of(captured.pixels), captured.unit))
        elif thinning.keeps(captured.time):
            height, width, _ = captured.pixels.shape
            answer(CameraShot(captured.time, width, height, jpeg_of_bgr(captured.pixels)))


def _opened_anew(camera: CameraConfig) -> CameraDevice:
    while True:
        time.sleep(_RETRY)
        with suppress(Exception):
            return open_device(camera)


def jpeg_of_bgr(pixels: Pixels) -> bytes:
    """Return a picture (height, width, 3) b g r as JPEG."""
    import cv2

    _, packed = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
    return bytes(packed.tobytes())


def png_of(depth: npt.NDArray[np.uint16]) -> bytes:
    """Return depth (height, width) as PNG, which keeps every number."""
    import cv2

    _, packed = cv2.imencode(".png", depth, (cv2.IMWRITE_PNG_COMPRESSION, 1))
    return bytes(packed.tobytes())
