"""A RealSense camera, read with its own library: colour, and depth as 16-bit numbers."""

from __future__ import annotations

import importlib.util
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from q2r2_control.cameras.device import (
    Capture,
    DepthCapture,
    capture_time,
    check_size,
    shown_device,
    size_before_rotation,
    turned,
)
from q2r2_control.config.recording import REALSENSE, CameraConfig
from q2r2_control.errors import CameraError
from q2r2_control.process.helper_process import reason_of

_PATIENCE_MS = 2000  # Longest wait for a frame of each stream [ms].
_WAITING = 4  # Largest number of frames that may wait to be read.
_ENOUGH = 0.9  # A stream with less than this share of the wanted rate is too slow.


class FoundRealSense(NamedTuple):
    """A RealSense camera of this computer."""

    serial: str
    name: str
    formats: tuple[str, ...]


def is_installed() -> bool:
    return importlib.util.find_spec("pyrealsense2") is not None


def found_cameras() -> Iterator[tuple[FoundRealSense, Any]]:
    """Yield the connected cameras, each with its ``pyrealsense2.device``; nothing if the library is not installed."""
    if not is_installed():
        return
    import pyrealsense2 as rs

    for device in rs.context().query_devices():
        yield described(device), device


def described(device: Any) -> FoundRealSense:
    """Return the serial number, the name and the formats of colour and depth of a ``pyrealsense2.device``."""
    import pyrealsense2 as rs

    info = rs.camera_info
    formats = {
        f"{profile.stream_type().name} {video.width()}x{video.height()} at {profile.fps()}/s"
        for _, profile in _profiles(device)
        for video in [profile.as_video_stream_profile()]
    }
    return FoundRealSense(device.get_info(info.serial_number), device.get_info(info.name), tuple(sorted(formats)))


def open_realsense(camera: CameraConfig) -> RealSense:
    """Open the camera with the serial number of the cell; raises :class:`CameraError`."""
    serial = str(camera.device).removeprefix(REALSENSE)
    try:
        known = {found.serial: device for found, device in found_cameras()}
        if serial not in known:
            allowed = ", ".join(f"{REALSENSE}{one}" for one in known) or "none is connected"
            raise CameraError(f"{shown_device(camera)}: no such camera; allowed: {allowed}")
        return RealSense(camera, known[serial])
    except RuntimeError as error:  # The library raises no other exceptions.
        raise CameraError(f"{shown_device(camera)}: it cannot be opened: {reason_of(error)}") from error


class RealSense:
    """An open RealSense camera. Implements :class:`CameraDevice`."""

    def __init__(self, camera: CameraConfig, device: Any) -> None:
        """Start the streams of a ``pyrealsense2.device``.

        Raises:
            CameraError: If the device has no stream of the size that the cell says.
            RuntimeError: If the library cannot start the streams.
        """
        import pyrealsense2 as rs

        self._rs, self._camera = rs, camera
        self._queue = rs.frame_queue(_WAITING)
        wanted = [rs.stream.color, rs.stream.depth] if camera.depth else [rs.stream.color]
        chosen: dict[Any, list[Any]] = defaultdict(list)  # The profiles of each sensor.
        for stream in wanted:
            sensor, profile = self._choose(device, stream)
            chosen[sensor].append(profile)
        self._sensors = []
        for sensor, profiles in chosen.items():
            sensor.open(profiles)
            self._sensors.append(sensor)
            sensor.start(self._queue)
        self._came = dict.fromkeys(wanted, time.monotonic())  # Receipt of the newest frame of each stream [s].

    def read(self) -> Capture | DepthCapture:
        has_come, frame = self._queue.try_wait_for_frame(_PATIENCE_MS)
        received = time.monotonic()
        if has_come:
            self._came[frame.get_profile().stream_type()] = received
        silent = [stream.name for stream, came in self._came.items() if received - came >= _PATIENCE_MS / 1e3]
        if silent or not has_come:
            raise CameraError(f"no {' and no '.join(silent) or 'frame'} within {_PATIENCE_MS / 1e3:g} s")
        stamp_ms = 0.0  # The stamp stays 0 if it is by the camera's own clock, whose offset is not known.
        if frame.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock:
            stamp_ms = frame.get_timestamp() + 1e3 * _monotonic_minus_unix_time()
        captured = capture_time(received, stamp_ms, self._camera.delay)
        # The pixels are copied, because the library reuses the memory of its frames.
        pixels = turned(np.array(frame.get_data()), self._camera)
        if frame.is_depth_frame():
            return DepthCapture(captured, pixels, frame.as_depth_frame().get_units())
        return Capture(captured, pixels)

    def close(self) -> None:
        """See :meth:`CameraDevice.close`. If a sensor is gone, the other sensors are closed all the same."""
        for sensor in self._sensors:
            for free in (sensor.stop, sensor.close):
                with suppress(RuntimeError):
                    free()

    def _choose(self, device: Any, stream: Any) -> tuple[Any, Any]:
        """Return the sensor and the profile of a stream whose size and rate fit the cell best."""
        found = [(sensor, profile) for sensor, profile in _profiles(device) if profile.stream_type() == stream]
        if not found:
            raise CameraError(f"{shown_device(self._camera)}: gives no {stream.name}; allowed: another camera")
        width, height = size_before_rotation(self._camera)

        def misfit(one: tuple[Any, Any]) -> tuple[float, float]:
            video, fps = one[1].as_video_stream_profile(), one[1].fps()
            too_slow = fps < _ENOUGH * self._camera.rate
            size = abs(video.width() - width) + abs(video.height() - height)
            return size, 1e3 / fps if too_slow else fps / 1e6

        sensor, profile = min(found, key=misfit)
        video = profile.as_video_stream_profile()
        check_size(self._camera, video.width(), video.height())
        return sensor, profile


def _monotonic_minus_unix_time() -> float:
    """Return the monotonic time minus the Unix time [s].

    The clocks are read one after the other, three times. The readings that were made in the shortest time are used.
    """
    found = []
    for _ in range(3):
        before, day, after = time.monotonic(), time.time(), time.monotonic()
        found.append((after - before, (before + after) / 2.0 - day))
    return min(found)[1]


def _profiles(device: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the sensors of a device with their profiles of colour in b g r, and of depth in 16 bits."""
    import pyrealsense2 as rs

    kinds = {(rs.stream.color, rs.format.bgr8), (rs.stream.depth, rs.format.z16)}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if (profile.stream_type(), profile.format()) in kinds:
                yield sensor, profile
