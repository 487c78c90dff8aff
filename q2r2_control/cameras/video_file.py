"""A video file that replaces a camera, for tests and rehearsals. It plays in real time."""

from __future__ import annotations

import time
from pathlib import Path

import cv2

from q2r2_control.cameras.device import Capture, address_of, check_size, shown_device, size_of, turned
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError


class VideoFile:
    """Plays a file, in a loop or once. Implements :class:`CameraDevice`.

    A picture is captured at the time at which the file shows it. A busy computer does not change these times, even if
    it reads a picture too late. No picture is left out.
    """

    def __init__(self, camera: CameraConfig) -> None:
        """Open the file; raises :class:`CameraError`."""
        self._camera, self._path = camera, address_of(camera)
        if not Path(self._path).is_file():
            raise CameraError(f"{shown_device(camera)}: no such file; allowed: a video, a device such as 0, an address")
        self._opened = cv2.VideoCapture(self._path, cv2.CAP_FFMPEG)
        self._fps = self._opened.get(cv2.CAP_PROP_FPS)
        if not self._opened.isOpened() or not self._fps > 0.0:
            raise CameraError(f"{shown_device(camera)}: no video that OpenCV can read; allowed: .mp4, .avi, .mkv")
        check_size(camera, *size_of(self._opened))
        self._began = time.monotonic()  # Time at which the file shows its first picture [s].
        self._shown = 0  # Number of pictures that were read since ``_began``.

    def read(self) -> Capture:
        if not self._opened.grab():
            if not self._camera.repeat:
                raise CameraError("the video has ended")
            self._begin_again()
        captured = self._began + self._opened.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        self._shown += 1
        time.sleep(max(captured - time.monotonic(), 0.0))
        _, pixels = self._opened.retrieve()
        return Capture(captured, turned(pixels, self._camera))

    def close(self) -> None:
        self._opened.release()

    def _begin_again(self) -> None:
        self._began += self._shown / self._fps
        self._shown = 0
        self._opened.release()
        if not (self._opened.open(self._path, cv2.CAP_FFMPEG) and self._opened.grab()):
            raise CameraError("the video cannot be read again")
