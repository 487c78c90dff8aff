"""The open cameras of a cell. Each gives its newest picture, and all pictures since the last call of ``take``."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from typing import TypeVar

from q2r2_control.cameras.camera_process import Answer, CameraLost, CameraShot, DepthShot
from q2r2_control.cameras.device import check_installed
from q2r2_control.cameras.newest_shots import NewestShots
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError
from q2r2_control.process.helper_process import HelperProcess, reason_of

_WAITING = 256  # Greatest number of a camera's pictures that wait for ``take``. If more come, the oldest are lost.
_READY = 120.0  # Longest wait for a camera's first picture [s]. A busy computer starts a camera's process slowly.
_Item = TypeVar("_Item")
_LOOKS = 0.02  # Time between two checks whether a picture has come [s].


class CameraStream:
    """One camera. Its process starts when the instance is created."""

    def __init__(self, name: str, camera: CameraConfig) -> None:
        """Raises :class:`CameraError` if the camera's package is missing, or its process cannot be started."""
        self.name, self.camera = name, camera
        self.newest: CameraShot | None = None
        self._lost: CameraLost | None = None
        self._waiting: deque[tuple[float, CameraShot]] = deque(maxlen=_WAITING)
        self._depths: deque[DepthShot] = deque(maxlen=_WAITING)
        self._hearers: list[Callable[[CameraShot], None]] = []
        try:
            check_installed(camera)
            module = "q2r2_control.cameras.camera_process"
            self.process = HelperProcess(f"reads camera {name}", module, self._on_answer)
        except (CameraError, OSError) as error:
            raise CameraError(f"cameras.{name}.device: {reason_of(error)}") from error
        self.process.send(camera)

    @property
    def why_lost(self) -> str | None:
        """The reported reason why the camera gives no pictures; None if it gives pictures, or if no reason is known."""
        return self.process.fault if self._lost is None or self.process.fault else self._lost.why

    def hear(self, hearer: Callable[[CameraShot], None]) -> None:
        """Call ``hearer`` with each picture from now on, in the thread that receives the pictures."""
        self._hearers.append(hearer)

    def take(self) -> list[tuple[float, CameraShot]]:
        """Return the pictures since the previous call, each with its time of receipt [s]. This method never waits."""
        return _taken(self._waiting)

    def take_depths(self) -> list[DepthShot]:
        """Return the depth pictures since the previous call. This method never waits."""
        return _taken(self._depths)

    def first_picture(self) -> CameraShot:
        """Wait until the camera has given a picture; raises :class:`CameraError` if it does not."""
        deadline = time.monotonic() + _READY
        while self.newest is None and self.why_lost is None and time.monotonic() < deadline:
            time.sleep(_LOOKS)
        if self.newest is None:
            why = self.why_lost or f"no picture within {_READY:g} s"
            raise CameraError(f"cameras.{self.name}.device: {why}")
        return self.newest

    def wait_for_pictures_until(self, end: float, longest: float) -> None:
        """Wait, at most ``longest`` [s], until all pictures captured before ``end`` [s] have come."""
        deadline = time.monotonic() + longest
        while self.why_lost is None and time.monotonic() < deadline:
            if self.newest is not None and self.newest.time >= end:
                return
            time.sleep(_LOOKS)

    def _on_answer(self, answer: Answer) -> None:
        if isinstance(answer, CameraLost):
            self._lost = answer
            return
        if isinstance(answer, DepthShot):
            self._depths.append(answer)
            return
        self._lost, self.newest = None, answer
        self._waiting.append((time.monotonic(), answer))
        for hearer in self._hearers:
            hearer(answer)


def _taken(waiting: deque[_Item]) -> list[_Item]:
    """Take all items out of a queue to which another thread adds items."""
    found = []
    with suppress(IndexError):
        while True:
            found.append(waiting.popleft())
    return found


class CameraStreams(AbstractContextManager["CameraStreams"]):
    """All real cameras of a cell, as a context manager around the runs that use them."""

    def __init__(self, cameras: Mapping[str, CameraConfig]) -> None:
        """Start a process for each camera; raises :class:`CameraError`."""
        self.streams: dict[str, CameraStream] = {}
        try:
            for name, camera in cameras.items():
                self.streams[name] = CameraStream(name, camera)
        except CameraError:
            self.close()
            raise

    def wait_until_ready(self) -> None:
        """Wait until each camera has given a picture. Raises :class:`CameraError` if a camera gives none."""
        for stream in self.streams.values():
            stream.first_picture()

    def newest_shots(self, realtime: bool) -> NewestShots:
        """Return the newest pictures at each tick of a run. ``realtime`` says whether the loop keeps real time."""
        return NewestShots(self.streams, realtime)

    def close(self) -> None:
        for stream in self.streams.values():
            stream.process.kill()

    def __exit__(self, *_: object) -> None:
        self.close()
