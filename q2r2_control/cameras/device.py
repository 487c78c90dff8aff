"""A camera as a device that gives pictures, each with the time of its capture."""

from __future__ import annotations

import importlib.util
import os
import re
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError
from q2r2_control.extras import install_line

Pixels = npt.NDArray[np.uint8]  # (height, width, 3) b g r, as OpenCV has them.
_PASSWORD = re.compile(r"(?<=://)[^/@]*@")
_RIGHT_ANGLE = 90  # [deg]
_OLDEST_STAMP = 1.0  # A driver's stamp that is older than this counts as a stamp of another clock [s].
_Number = TypeVar("_Number", np.uint8, np.uint16)


class Capture(NamedTuple):
    time: float  # Time of the capture, by the monotonic clock of this computer [s].
    pixels: Pixels


class DepthCapture(NamedTuple):
    time: float  # Time of the capture, by the monotonic clock of this computer [s].
    pixels: npt.NDArray[np.uint16]  # (height, width) Depth in multiples of ``unit``; 0 where it is not known.
    unit: float  # The depth that the number 1 means [m].


class CameraDevice(Protocol):
    """An open camera."""

    def read(self) -> Capture | DepthCapture:
        """Wait for the next picture, or for the next depth picture if the camera's depth is recorded.

        Raises:
            CameraError: If no more pictures come.
        """

    def close(self) -> None:
        """Free the device, so that others can open it."""


def check_installed(camera: CameraConfig) -> None:
    """Raise :class:`CameraError` if the Python package that reads the camera is not installed."""
    if camera.device_kind == "realsense" and importlib.util.find_spec("pyrealsense2") is None:
        raise CameraError(f"{shown_device(camera)}: needs pyrealsense2: {install_line('realsense')}")
    if importlib.util.find_spec("cv2") is None:
        raise CameraError(f"{shown_device(camera)}: needs OpenCV: {install_line('cameras')}")


def shown_device(camera: CameraConfig) -> str:
    """Return the name of the device for messages, without the password that an address may have."""
    return _PASSWORD.sub("", str(camera.device))


def address_of(camera: CameraConfig) -> str:
    """Return the path or address to open. ``$NAME`` is replaced by the environment variable NAME, e.g. a password."""
    return os.path.expandvars(str(camera.device))


def size_before_rotation(camera: CameraConfig) -> tuple[int, int]:
    """Return the width and height [pixels] of the pictures as the device gives them."""
    size = camera.width, camera.height
    return size[::-1] if camera.rotation % (2 * _RIGHT_ANGLE) else size


def capture_time(received: float, stamp_ms: float, delay: float) -> float:
    """Return when a picture was captured, by the monotonic clock [s].

    Args:
        received: Time of its receipt [s].
        stamp_ms: Stamp of the driver [ms]. V4L2 drivers use the monotonic clock. Other drivers give 0, or the time
            since their stream began.
        delay: Time from the capture to the receipt [s]. It is used if the stamp does not come from the monotonic clock.
    """
    stamp = stamp_ms / 1e3
    return stamp if 0.0 <= received - stamp < _OLDEST_STAMP else received - delay


def turned(pixels: npt.NDArray[_Number], camera: CameraConfig) -> npt.NDArray[_Number]:
    """Return a picture of the device, turned clockwise by ``camera.rotation`` [deg]."""
    return np.ascontiguousarray(np.rot90(pixels, -camera.rotation // _RIGHT_ANGLE))


def check_size(camera: CameraConfig, width: int, height: int) -> None:
    """Raise :class:`CameraError` unless the device gives pictures of the size that the cell says."""
    if (width, height) != size_before_rotation(camera):
        given = (height, width) if camera.rotation % (2 * _RIGHT_ANGLE) else (width, height)
        raise CameraError(
            f"{shown_device(camera)}: gives no {camera.width}x{camera.height}; the nearest that it gives is "
            f"{given[0]}x{given[1]}; allowed: width: {given[0]}, height: {given[1]}"
        )


def size_of(opened: Any) -> tuple[int, int]:
    """Return the width and height [pixels] of the pictures of a ``cv2.VideoCapture``."""
    import cv2

    return round(opened.get(cv2.CAP_PROP_FRAME_WIDTH)), round(opened.get(cv2.CAP_PROP_FRAME_HEIGHT))
