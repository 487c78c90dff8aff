"""The formats of V4L2 devices are read from the structures of the kernel's <linux/videodev2.h>.

The computers that run the tests have no camera, so a function answers instead of a driver. It builds the same
structures with ctypes, whose fields have names. If the code reads a number at a wrong offset, the test therefore fails.
"""

from __future__ import annotations

import ctypes
import errno
from pathlib import Path

import pytest

from q2r2_control.cameras import v4l2

YUYV, MJPG = (int.from_bytes(name, "little") for name in (b"YUYV", b"MJPG"))
SIZES = {YUYV: [(640, 480)], MJPG: [(640, 480), (1280, 720)]}
INTERVALS = {YUYV: [(1, 30)], MJPG: [(1, 60), (1, 30)]}


class FormatDescription(ctypes.Structure):
    _fields_ = (
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("description", ctypes.c_char * 32),
        ("pixelformat", ctypes.c_uint32),
        ("mbus_code", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    )


class FrameSize(ctypes.Structure):
    _fields_ = (
        ("index", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("others", ctypes.c_uint32 * 4),  # Further numbers that only a range of sizes has.
        ("reserved", ctypes.c_uint32 * 2),
    )


class FrameInterval(ctypes.Structure):
    _fields_ = (
        ("index", ctypes.c_uint32),
        ("pixel_format", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("numerator", ctypes.c_uint32),
        ("denominator", ctypes.c_uint32),
        ("others", ctypes.c_uint32 * 4),
        ("reserved", ctypes.c_uint32 * 2),
    )


def request_number(number: int, structure: type[ctypes.Structure]) -> int:
    """Return the request that the kernel's macro _IOWR('V', number, structure) makes."""
    return 3 << 30 | ctypes.sizeof(structure) << 16 | ord("V") << 8 | number


def answer(file: int, request: int, data: bytes) -> bytes:
    try:
        if request == request_number(2, FormatDescription):
            description = FormatDescription.from_buffer_copy(data)
            assert description.type == 1, "of single-planar capture"
            description.pixelformat = list(SIZES)[description.index]
            return bytes(description)
        if request == request_number(74, FrameSize):
            size = FrameSize.from_buffer_copy(data)
            size.type, (size.width, size.height) = 1, SIZES[size.pixel_format][size.index]
            return bytes(size)
        assert request == request_number(75, FrameInterval)
        interval = FrameInterval.from_buffer_copy(data)
        assert (interval.width, interval.height) in SIZES[interval.pixel_format]
        interval.type = 1
        interval.numerator, interval.denominator = INTERVALS[interval.pixel_format][interval.index]
        return bytes(interval)
    except IndexError as error:
        raise OSError(errno.EINVAL, "no more entries") from error


def test_all_formats_sizes_and_rates_of_a_v4l2_device_are_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(v4l2, "ioctl", answer)
    (tmp_path / "video0").touch()
    assert list(map(str, v4l2.formats_of(str(tmp_path / "video0")))) == [
        "YUYV 640x480 at 30/s",
        "MJPG 640x480 at 60, 30/s",
        "MJPG 1280x720 at 60, 30/s",
    ]
