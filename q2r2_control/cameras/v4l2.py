"""List the V4L2 devices of this computer, and find out why a device cannot be opened, with Linux's own interface."""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from fcntl import ioctl
from pathlib import Path
from typing import Any, NamedTuple

from q2r2_control.config.recording import CameraConfig

# Requests and structures of <linux/videodev2.h>.
_QUERYCAP, _CAPABILITY = 0x80685600, struct.Struct("=16s32s32s3I12x")
_ENUM_FMT, _FORMAT = 0xC0405602, struct.Struct("=3I32sI16x")
_ENUM_FRAMESIZES, _SIZE = 0xC02C564A, struct.Struct("=3I2I24x")
_ENUM_FRAMEINTERVALS, _INTERVAL = 0xC034564B, struct.Struct("=5I2I24x")
_CAPTURES, _HAS_DEVICE_CAPS = 0x1, 0x80000000  # Bits of a device's capabilities.
# The type of buffers for pictures, and the type of frame sizes and intervals that are listed one by one.
_VIDEO_CAPTURE, _DISCRETE = 1, 1
_MOST = 200  # Greatest number of entries that are read from a list of the driver.
_NO_PICTURES = "no camera: it gives no pictures"


class FrameFormat(NamedTuple):
    """A format that a device gives."""

    coding: str  # Four letters, such as MJPG or YUYV.
    width: int
    height: int
    rates: tuple[float, ...]  # [pictures/s], in the driver's order; empty if the driver gives ranges only.

    def __str__(self) -> str:
        rates = ", ".join(f"{rate:g}" for rate in self.rates) or "?"
        return f"{self.coding} {self.width}x{self.height} at {rates}/s"


def device_path(camera: CameraConfig) -> str:
    number = str(camera.device)
    return f"/dev/video{number}" if number.isdigit() else number


def capture_devices() -> dict[str, str]:
    """Return the names of the devices that give pictures, by path. Devices that the user may not open are included."""
    found = {}
    folders = Path("/sys/class/video4linux").glob("video*")
    for folder in sorted(folders, key=lambda folder: int(folder.name.removeprefix("video") or 0)):
        path = f"/dev/{folder.name}"
        with suppress(OSError):
            name = (folder / "name").read_text(encoding="utf-8", errors="replace").strip()
            # A camera may have further devices that give no pictures, such as a device for metadata. They are left out.
            if fault_of(path) != _NO_PICTURES:
                found[path] = name
    return found


def fault_of(path: str) -> str | None:
    """Return why a device cannot be opened as a camera; None if it can be.

    While another program reads the device, this function can return None although the device gives no pictures.
    """
    try:
        file = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        match error.errno:
            case errno.ENOENT | errno.ENXIO | errno.ENODEV:
                known = ", ".join(capture_devices()) or "this computer has none"
                return f"no such device; allowed: {known}"
            case errno.EACCES | errno.EPERM:
                return "no permission; allowed: for users of its group: sudo usermod -aG video $USER, and log in anew"
            case errno.EBUSY:
                return "busy: another program uses it"
        return f"cannot be opened: {error.strerror}"
    try:
        answer = ioctl(file, _QUERYCAP, bytes(_CAPABILITY.size))
    except OSError:
        return "no camera: it is no V4L2 device"
    finally:
        os.close(file)
    *_, of_all, of_this = _CAPABILITY.unpack(answer)
    return None if (of_this if of_all & _HAS_DEVICE_CAPS else of_all) & _CAPTURES else _NO_PICTURES


def formats_of(path: str) -> list[FrameFormat]:
    """Return a device's formats for those sizes that the driver lists one by one. Raises :class:`OSError`."""
    file = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    try:
        return [
            FrameFormat(coding.to_bytes(4, "little").decode("ascii", "replace"), width, height, rates)
            for coding in _codings(file)
            for width, height in _sizes(file, coding)
            for rates in [tuple(_rates(file, coding, width, height))]
        ]
    finally:
        os.close(file)


def _codings(file: int) -> Iterator[int]:
    for answer in _answers(file, _ENUM_FMT, _FORMAT, lambda index: (index, _VIDEO_CAPTURE, 0, b"", 0)):
        yield answer[4]


def _sizes(file: int, coding: int) -> Iterator[tuple[int, int]]:
    for answer in _answers(file, _ENUM_FRAMESIZES, _SIZE, lambda index: (index, coding, 0, 0, 0)):
        if answer[2] == _DISCRETE:
            yield answer[3], answer[4]


def _rates(file: int, coding: int, width: int, height: int) -> Iterator[float]:
    def asked(index: int) -> tuple[int, ...]:
        return index, coding, width, height, 0, 0, 0

    for answer in _answers(file, _ENUM_FRAMEINTERVALS, _INTERVAL, asked):
        if answer[4] == _DISCRETE and answer[5]:
            yield answer[6] / answer[5]


def _answers(
    file: int, request: int, form: struct.Struct, asked: Callable[[int], tuple[Any, ...]]
) -> Iterator[tuple[Any, ...]]:
    """Yield the driver's answers to a request for entry 0, 1, ... of a list."""
    for index in range(_MOST):
        try:
            answer = ioctl(file, request, form.pack(*asked(index)))
        except OSError:  # The request fails if the list has no more entries.
            return
        yield form.unpack(answer)
