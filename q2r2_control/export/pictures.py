"""Which recorded picture belongs to a frame: the newest that was taken at or before it."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.errors import RecordingError
from q2r2_control.recording.reader import Picture, Recording

Pixels = npt.NDArray[np.uint8]  # (height, width, 3) r g b

_OLDEST = 2  # periods of the camera: one picture may be lost
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class CameraFrames:
    """Pictures of one camera, one for each frame of an episode."""

    recording: Recording
    name: str
    config: CameraConfig
    stamps: Sequence[int]  # times of day of the frames [ns], ascending

    @property
    def size(self) -> tuple[int, int, int]:
        """Rows, columns and colours of a picture."""
        return (self.config.height, self.config.width, 3)

    def __iter__(self) -> Iterator[Pixels]:
        """Raises :class:`RecordingError` for a frame whose newest picture is older than two of the camera's periods."""
        return _pictures_at(self.recording, self.name, self.config, self.stamps)


def _pictures_at(recording: Recording, name: str, camera: CameraConfig, stamps: Sequence[int]) -> Iterator[Pixels]:
    pictures = recording.pictures(name)
    newest: Picture | None = None
    coming = next(pictures, None)
    pixels: Pixels | None = None
    for stamp in stamps:
        while coming is not None and coming.time <= stamp:
            newest, coming, pixels = coming, next(pictures, None), None
        if newest is None or (stamp - newest.time) * camera.rate > _OLDEST * _NANOSECONDS:
            when = (stamp - recording.about.epoch) / _NANOSECONDS
            age = "no picture yet" if newest is None else f"a picture {(stamp - newest.time) / _NANOSECONDS:.3f} s old"
            raise RecordingError(
                f"{recording.file}: camera {name} has {age} at {when:.3f} s; allowed: at most two of its periods, "
                f"{_OLDEST / camera.rate:.3f} s; --no-pictures leaves them out"
            )
        if pixels is None:
            pixels = _decoded(recording, name, camera, newest)
        yield pixels


def _decoded(recording: Recording, name: str, camera: CameraConfig, picture: Picture) -> Pixels:
    try:
        pixels = np.asarray(Image.open(io.BytesIO(picture.jpeg)).convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise RecordingError(f"{recording.file}: damaged: a picture of camera {name} is no JPEG") from error
    if pixels.shape != (camera.height, camera.width, 3):
        raise RecordingError(f"{recording.file}: damaged: a picture of camera {name} has a size that the cell has not")
    return pixels
