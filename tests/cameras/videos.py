"""Videos whose pictures show their own number, so that a test knows when each picture was captured."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

WIDTH, HEIGHT = 64, 48  # [pixels]
FPS = 25.0  # [pictures/s]
# Even busy machines keep this rate. A picture that is late by two periods can be neither judged well nor exported.
SLOW_FPS = 5.0  # [pictures/s]
_BITS = 8  # The number of bits of a picture's number. Each bit is a bright or dark column of pixels.
_MIDDLE = 128


def write_video(path: Path, numbers: Iterable[int], size: tuple[int, int] = (WIDTH, HEIGHT), fps: float = FPS) -> Path:
    """Write a video whose pictures show these numbers."""
    cv2 = pytest.importorskip("cv2")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for number in numbers:
        writer.write(numbered(number, size))
    writer.release()
    return path


def numbered(number: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> npt.NDArray[np.uint8]:
    """Return the picture (height, width, 3) that shows a ``number``, its lowest bit on the left."""
    bits = np.array([255 * (number >> bit & 1) for bit in range(_BITS)], dtype=np.uint8)
    row = np.repeat(bits, size[0] // _BITS)
    return np.repeat(np.tile(row, (size[1], 1))[:, :, None], 3, axis=2)


def number_in(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> int:
    """Return the number that a picture (height, width, 3) shows."""
    blocks = pixels.mean(axis=(0, 2)).reshape(_BITS, -1).mean(axis=1)
    return sum(1 << bit for bit in range(_BITS) if blocks[bit] > _MIDDLE)


def number_of_jpeg(jpeg: bytes) -> int:
    return number_in(np.asarray(Image.open(io.BytesIO(jpeg))))
