"""A RealSense camera without hardware: a software device of pyrealsense2, which gets its frames from a test."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.cameras.videos import HEIGHT, WIDTH, numbered

SERIAL, FPS, UNIT = "042", 30, 1e-4  # Serial number, frames per second, unit of depth [m].


class SoftwareRealSense:
    """A camera with a colour sensor and a depth sensor."""

    def __init__(self, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        self._rs: Any = pytest.importorskip("pyrealsense2")
        self._size, self.device = size, self._rs.software_device()
        self.device.register_info(self._rs.camera_info.serial_number, SERIAL)
        self.device.register_info(self._rs.camera_info.name, "a camera")
        self._colour, self._depth = (self.device.add_sensor(name) for name in ("RGB Camera", "Stereo Module"))
        self._of_colour = self._colour.add_video_stream(self._stream(self._rs.stream.color, self._rs.format.bgr8, 3))
        self._of_depth = self._depth.add_video_stream(self._stream(self._rs.stream.depth, self._rs.format.z16, 2))
        self._number = 0

    def _stream(self, kind: Any, format: Any, size_of_pixel: int) -> Any:
        stream, lens = self._rs.video_stream(), self._rs.intrinsics()
        stream.width, stream.height = lens.width, lens.height = self._size
        lens.model = self._rs.distortion.none
        stream.type, stream.fmt, stream.bpp, stream.intrinsics = kind, format, size_of_pixel, lens
        stream.fps, stream.uid = FPS, size_of_pixel
        return stream

    def show(self, number: int, time_of_day: float) -> None:
        """Give a colour frame that shows ``number`` and was captured at ``time_of_day`` [s]."""
        self._give(self._colour, self._of_colour, numbered(number, self._size), time_of_day)

    def show_depth(self, depth: npt.NDArray[np.uint16], time_of_day: float) -> None:
        """Give a depth frame (height, width), in multiples of :data:`UNIT`, captured at ``time_of_day`` [s]."""
        self._give(self._depth, self._of_depth, depth, time_of_day)

    def _give(self, sensor: Any, profile: Any, pixels: npt.NDArray[Any], time_of_day: float) -> None:
        frame = self._rs.software_video_frame()
        frame.pixels, frame.bpp = pixels, pixels[0, 0].nbytes
        frame.stride = self._size[0] * frame.bpp
        frame.timestamp, frame.domain = 1e3 * time_of_day, self._rs.timestamp_domain.system_time
        frame.profile, frame.frame_number = profile.as_video_stream_profile(), self._number
        if pixels.dtype == np.uint16:
            frame.depth_units = UNIT
        self._number += 1
        sensor.on_video_frame(frame)


class StoppedClock:
    """Replaces the module ``time``. Its clocks go on only if a test changes :attr:`passed`."""

    def __init__(self) -> None:
        self.passed = 0.0  # [s]

    def monotonic(self) -> float:
        return 100.0 + self.passed

    def time(self) -> float:
        return 1.8e9 + self.passed
