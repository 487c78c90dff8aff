"""The newest picture of each open camera at a tick, for a policy."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from q2r2_control.cameras.camera_watch import longest_silence
from q2r2_control.cameras.loop_times import LoopTimes, TickTime
from q2r2_control.types import ObservedPicture

if TYPE_CHECKING:
    from q2r2_control.cameras.camera_streams import CameraStream


class ReadPicture:
    """A picture of a real camera. Implements :class:`ObservedPicture`."""

    def __init__(self, time: float, jpeg: bytes) -> None:
        self.time, self.jpeg = time, jpeg

    @cached_property
    def pixels(self) -> npt.NDArray[np.uint8]:
        from PIL import Image  # Pillow is imported only when a policy uses pixels.

        return np.array(Image.open(io.BytesIO(self.jpeg)).convert("RGB"))


class NewestShots:
    """The newest pictures of the open cameras at each tick of one run."""

    def __init__(self, streams: Mapping[str, CameraStream], realtime: bool) -> None:
        """``streams`` are the open cameras. If ``realtime`` is True, the loop's clock is the computer's."""
        self._streams, self._realtime, self._times = streams, realtime, LoopTimes()
        self._pictures: dict[str, ReadPicture] = {}  # The newest picture of each camera.

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the open cameras."""
        return tuple(self._streams)

    def at(self, now: float) -> tuple[dict[str, ObservedPicture], dict[str, str]]:
        """Return the newest picture of each camera at the tick of time ``now`` [s]. This method never waits.

        The second mapping has each camera without a usable picture, and the reason why it has none.
        """
        found: dict[str, ObservedPicture] = {}
        reasons: dict[str, str] = {}
        computer = now if self._realtime else time.monotonic()
        self._times.add(TickTime(computer, now, 0))
        for name, stream in self._streams.items():
            if (why := self._why_lost(stream, computer)) is not None:
                reasons[name] = why
            else:
                found[name] = self._pictures[name]
        return found, reasons

    def _why_lost(self, stream: CameraStream, computer: float) -> str | None:
        """Keep the newest picture. Return why it is missing or too old for a policy, or None if it may be used."""
        if (shot := stream.newest) is None:
            return f"no picture yet{_because(stream)}"
        known = self._pictures.get(stream.name)
        if known is None or known.jpeg is not shot.jpeg:
            self._pictures[stream.name] = ReadPicture(self._times.at(shot.time).loop, shot.jpeg)
        age = computer - shot.time - stream.camera.delay
        return f"no picture for {age:.1f} s{_because(stream)}" if age >= longest_silence(stream.camera) else None


def _because(stream: CameraStream) -> str:
    return "" if stream.why_lost is None else f": {stream.why_lost}"
