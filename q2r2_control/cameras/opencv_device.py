"""A camera that OpenCV opens: a V4L2 device of this computer, or a stream of an RTSP or HTTP address."""

from __future__ import annotations

import time

import cv2

from q2r2_control.cameras.device import (
    Capture,
    address_of,
    capture_time,
    check_size,
    shown_device,
    size_before_rotation,
    size_of,
    turned,
)
from q2r2_control.cameras.v4l2 import device_path, fault_of
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError

_PATIENCE_MS = 5000  # Longest wait for a network camera [ms].
_ENOUGH = 0.9  # If a device offers less than this share of the cell's rate, MJPG is requested.
_EXPOSURE_UNIT = 1e-4  # The unit of V4L2_CID_EXPOSURE_ABSOLUTE: 100 us [s].
_MANUAL_EXPOSURE = 1  # V4L2_EXPOSURE_MANUAL
_MJPG = cv2.VideoWriter.fourcc(*"MJPG")


class OpenCvDevice:
    """A live camera. Implements :class:`CameraDevice`."""

    def __init__(self, camera: CameraConfig) -> None:
        """Open the camera; raises :class:`CameraError`."""
        self._camera, self._is_local = camera, camera.device_kind == "v4l2"
        self._opened = self._open_v4l2() if self._is_local else self._open_address()
        try:
            check_size(camera, *size_of(self._opened))
        except CameraError:
            self.close()
            raise

    def read(self) -> Capture:
        if not self._opened.grab():
            raise CameraError(
                (fault_of(device_path(self._camera)) if self._is_local else None) or "its stream has ended"
            )
        received = time.monotonic()
        stamp_ms = self._opened.get(cv2.CAP_PROP_POS_MSEC) if self._is_local else 0.0
        was_decoded, pixels = self._opened.retrieve()
        if not was_decoded:
            raise CameraError("a picture cannot be decoded")
        return Capture(capture_time(received, stamp_ms, self._camera.delay), turned(pixels, self._camera))

    def close(self) -> None:
        self._opened.release()

    def _open_v4l2(self) -> cv2.VideoCapture:
        path = device_path(self._camera)
        if (fault := fault_of(path)) is not None:
            raise CameraError(f"{path}: {fault}")
        opened = cv2.VideoCapture(path, cv2.CAP_V4L2)
        if not opened.isOpened():
            raise CameraError(f"{path}: it cannot be opened for pictures: another program may use it")
        self._choose_format(opened)
        if self._camera.exposure is not None:
            opened.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            if not opened.set(cv2.CAP_PROP_EXPOSURE, self._camera.exposure / _EXPOSURE_UNIT):
                opened.release()
                raise CameraError(f"{path}: its exposure cannot be set; allowed: exposure: null")
        return opened

    def _choose_format(self, opened: cv2.VideoCapture) -> None:
        """Set size and rate. If the device's own format does not reach them, use MJPG, which needs less bandwidth."""
        width, height = size_before_rotation(self._camera)
        for fourcc in (None, _MJPG):
            if fourcc is not None:
                opened.set(cv2.CAP_PROP_FOURCC, fourcc)
            opened.set(cv2.CAP_PROP_FRAME_WIDTH, width)
            opened.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
            opened.set(cv2.CAP_PROP_FPS, self._camera.rate)
            fast = opened.get(cv2.CAP_PROP_FPS) >= _ENOUGH * self._camera.rate
            if fast and size_of(opened) == (width, height):
                return

    def _open_address(self) -> cv2.VideoCapture:
        patience = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _PATIENCE_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _PATIENCE_MS)
        opened = cv2.VideoCapture(address_of(self._camera), cv2.CAP_FFMPEG, patience)
        if not opened.isOpened():
            where = shown_device(self._camera)
            raise CameraError(f"{where}: no stream of pictures there within {_PATIENCE_MS / 1e3:g} s")
        return opened
