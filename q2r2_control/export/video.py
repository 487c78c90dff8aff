"""Videos as LeRobot has them: AV1 in MP4, a key frame for every two frames, some episodes behind each other in a file.

Codec, quality and which pictures count for statistics are those of lerobot 0.4.4 (``datasets/video_utils.py``,
``datasets/compute_stats.py``), so that datasets of both can be joined.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError
from q2r2_control.export.pictures import Pixels
from q2r2_control.export.statistics import QUANTILES, Statistics
from q2r2_control.export.thread_policies import left_as_they_are

FILE_SIZE = 200  # [MB]; an episode that would not fit begins a new file
CODEC, PIXEL_FORMAT = "av1", "yuv420p"
_ENCODER = "libsvtav1"
# One thread, since there are processes enough; what is encoded is the same for any number.
_OPTIONS = {"g": "2", "crf": "30", "preset": "12", "svtav1-params": "lp=1"}
_LEAST_SAMPLES, _MOST_SAMPLES, _SAMPLES_POWER = 100, 10_000, 0.75  # pictures of an episode that count for statistics
_LARGE, _REDUCED = 300, 150  # [pixels]: larger pictures are thinned out to about the second size for statistics


def require_av() -> Any:
    """The module av (PyAV). Raises :class:`ConfigError` where it is not installed."""
    try:
        import av
    except ImportError as error:
        raise ConfigError("export lerobot of pictures needs av: pip install 'q2r2_control[export]'") from error
    os.environ.setdefault("SVT_LOG", "1")  # errors only: the encoder tells of itself otherwise
    return av


def encode(pictures: Iterable[Pixels], count: int, path: Path, fps: int) -> Statistics:
    """Write ``count`` pictures of one size as a video, and return what is said of them."""
    av = require_av()
    counted = set(_sampled(count))
    statistics = PixelStatistics()
    stream: Any = None
    with av.open(str(path), "w", format="mp4") as output:
        for number, pixels in enumerate(pictures):
            if stream is None:
                stream = output.add_stream(_ENCODER, fps, options=_OPTIONS)
                stream.pix_fmt = PIXEL_FORMAT
                stream.height, stream.width = pixels.shape[:2]
                with left_as_they_are():
                    stream.codec_context.open()
            output.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
            if number in counted:
                statistics.add(_thinned(pixels))
        output.mux(stream.encode())
    return statistics.result()


def _sampled(count: int) -> list[int]:
    """Numbers of the pictures of an episode that count."""
    samples = max(min(_LEAST_SAMPLES, count), min(int(count**_SAMPLES_POWER), _MOST_SAMPLES))
    return [int(number) for number in np.round(np.linspace(0, count - 1, samples))]


def _thinned(pixels: Pixels) -> Pixels:
    height, width = pixels.shape[:2]
    if max(width, height) < _LARGE:
        return pixels
    step = int(max(width, height) / _REDUCED)
    return pixels[::step, ::step]


class PixelStatistics:
    """Statistics of the colours of pictures, 0 .. 1, from how often each of their 256 values occurs."""

    def __init__(self) -> None:
        self._occurrences = np.zeros((3, 256), dtype=np.int64)
        self._pictures = 0

    def add(self, pixels: Pixels) -> None:
        """Count one picture."""
        self._pictures += 1
        for channel, occurrences in enumerate(self._occurrences):
            occurrences += np.bincount(pixels[..., channel].ravel(), minlength=256)

    def result(self) -> Statistics:
        """As :func:`statistics_of`, each (3,) of r g b; ``count`` is that of pictures."""
        values = np.arange(256) / 255.0
        total = self._occurrences.sum(axis=1)
        mean = self._occurrences @ values / total
        square = self._occurrences @ values**2 / total
        below = np.cumsum(self._occurrences, axis=1)

        def quantile(share: float) -> npt.NDArray[np.float64]:
            return values[(below >= share * total[:, None]).argmax(axis=1)]

        return {
            "min": values[(below > 0).argmax(axis=1)],
            "max": values[(below >= total[:, None]).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(square - mean**2, 0.0)),
            "count": np.array([self._pictures]),
            **{name: quantile(share) for name, share in QUANTILES.items()},
        }


class VideoFiles:
    """The files of one camera: episodes behind each other, copied as they were encoded."""

    def __init__(self) -> None:
        self._av = require_av()
        self._output: Any = None
        self._stream: Any = None
        self.number = -1  # of the file that is being written
        self._size, self._frames = 0, 0  # in it

    def fits(self, episode: Path) -> bool:
        """Whether an episode's video belongs into the file that is being written."""
        return self._output is not None and self._size + episode.stat().st_size <= FILE_SIZE << 20

    def begin(self, path: Path) -> None:
        """Go on with the next file."""
        self.close()
        self._output = self._av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
        self.number, self._size, self._frames = self.number + 1, 0, 0

    def add(self, episode: Path, frames: int) -> int:
        """Append an episode's video; returns how many frames were in the file before it."""
        before = self._frames
        with self._av.open(str(episode)) as source:
            (video,) = source.streams.video
            if not before:
                self._stream = self._output.add_stream_from_template(video, opaque=True)
                self._stream.time_base = video.time_base
            shift = round(before / (video.average_rate * video.time_base))
            for packet in source.demux(video):
                if packet.dts is None:  # behind the last one
                    continue
                packet.pts, packet.dts, packet.stream = packet.pts + shift, packet.dts + shift, self._stream
                self._output.mux(packet)
        self._size, self._frames = self._size + episode.stat().st_size, before + frames
        return before

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._output is not None:
            self._output.close()
            self._output = None
