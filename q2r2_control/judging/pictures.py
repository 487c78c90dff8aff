"""Read the pictures of a recording's cameras, and keep a small view of each, so that an episode fits into memory."""

from __future__ import annotations

import io
import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image

from q2r2_control.config.recording import CameraConfig
from q2r2_control.recording.messages import NANOSECONDS
from q2r2_control.recording.reader import BROKEN, Picture, Recording
from q2r2_control.types import Array, Flags

VIEW = (24, 32)  # The rows and columns of a view.
_SCAN, _END = b"\xff\xda", b"\xff\xd9"  # The markers before and after the coded pixels of a JPEG.
# Within coded pixels a byte 0xFF is followed by 0, by a restart marker, by the end marker, or by another 0xFF (ITU
# T.81, B.1.1.2 and F.1.2.3). A decoder goes on after any other byte, with pixels that the camera never saw.
_FOREIGN_MARKER = re.compile(rb"\xff[\x01-\xcf\xda-\xfe]")


@dataclass(frozen=True)
class Pictures:
    """The k pictures of one camera, in the order of time."""

    t: Array  # (k,) The time of the tick that a picture shows, since the recording began [s].
    views: npt.NDArray[np.uint8]  # (k, *VIEW) The averaged brightness; zeros if a picture could not be decoded.
    repeated: Flags  # (k,) True if every pixel is the same as in the picture before.
    damaged: Flags  # (k,) True if the picture could not be decoded completely.
    other_size: Flags  # (k,) True if the picture has another size than the cell says for the camera.

    def between(self, start: float, end: float, origin: float) -> Pictures:
        """Return the pictures from ``start`` to ``end`` [s], with times since ``origin`` [s]."""
        inside = (start <= self.t) & (self.t <= end)
        cut = {name: values[inside] for name, values in vars(self).items()}
        return Pictures(**cut | {"t": cut["t"] - origin})


class _Look(NamedTuple):
    """The data that is kept of one picture; see the fields of :class:`Pictures` with the same names."""

    t: float
    view: npt.NDArray[np.uint8]
    repeated: bool = False
    damaged: bool = False
    other_size: bool = False


def read_pictures(recording: Recording, cameras: dict[str, CameraConfig]) -> dict[str, Pictures]:
    """Read all pictures of ``cameras``, by name; raises :class:`RecordingError` if the file is damaged."""
    looks: dict[str, list[_Look]] = {name: [] for name in cameras}
    last: defaultdict[str, bytes] = defaultdict(bytes)
    for name, picture in recording.pictures_of(cameras):
        t = (picture.time - recording.about.epoch) / NANOSECONDS
        if looks[name] and picture.jpeg == last[name]:
            looks[name].append(looks[name][-1]._replace(t=t, repeated=True))
            continue
        looks[name].append(_look_at(picture, t, cameras[name]))
        last[name] = picture.jpeg
    return {name: pictures_of(found) for name, found in looks.items()}


def pictures_of(looks: Iterable[_Look]) -> Pictures:
    found = list(looks)
    flags = (np.array([look[column] for look in found], dtype=bool) for column in range(2, len(_Look._fields)))
    views = np.array([look.view for look in found], dtype=np.uint8).reshape(-1, *VIEW)
    return Pictures(np.array([look.t for look in found], dtype=np.float64), views, *flags)


def _look_at(picture: Picture, t: float, camera: CameraConfig) -> _Look:
    try:
        image = Image.open(io.BytesIO(picture.jpeg))
        other_size = image.size != (camera.width, camera.height)
        image.draft("L", (2 * VIEW[1], 2 * VIEW[0]))  # With fewer pixels, the decoder is several times as fast.
        view = image.convert("L").resize(VIEW[::-1], Image.Resampling.BOX)
    except (OSError, SyntaxError, Image.DecompressionBombError, *BROKEN):
        return _Look(t, np.zeros(VIEW, np.uint8), damaged=True)
    return _Look(t, np.asarray(view), damaged=_has_foreign_marker(picture.jpeg), other_size=other_size)


def _has_foreign_marker(jpeg: bytes) -> bool:
    """Return whether the coded pixels of a JPEG were overwritten: they contain a marker that is not allowed there."""
    scan = jpeg.rfind(_SCAN)  # A JPEG may contain a preview picture, whose marker comes first.
    if scan < 0:
        return False
    begin = scan + len(_SCAN) + int.from_bytes(jpeg[scan + 2 : scan + 4], "big")
    return _FOREIGN_MARKER.search(jpeg, begin, max(jpeg.rfind(_END), begin)) is not None
