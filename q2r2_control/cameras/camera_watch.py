"""Notices when a camera stops, slows down, changes the size of its pictures, or comes back.

This module reads no clock. The callers pass all times.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from q2r2_control.cameras.reasons import CameraReason
from q2r2_control.config.recording import CameraConfig
from q2r2_control.events import Reason, ReasonKind

# A camera has stopped if no picture has come for at least this number of its periods and for at least this time [s].
_STOPPED_PERIODS, _STOPPED_AFTER = 5.0, 1.0
_WINDOW = 2.0  # Time over which the rate of a camera is measured [s].
# The delays of successive pictures are added up. If the sum is at least 1 - _NEARLY periods, a picture counts as
# missing. Only the share _REMEMBERS of the sum still counts at the next picture.
_NEARLY, _REMEMBERS = 0.3, 0.9
# If the measured rate is below the first share of the camera's rate, the camera counts as slow. It then counts as slow
# until the measured rate reaches the second share.
_SLOW, _FAST_ENOUGH = 0.8, 0.9


def longest_silence(camera: CameraConfig) -> float:
    """Return the time without a picture after which a camera has stopped [s]."""
    return max(_STOPPED_AFTER, _STOPPED_PERIODS / camera.rate)


class MissingPictures:
    """Counts the pictures of a camera that are missing, from the times of the pictures that came.

    Pictures of a real camera come unevenly, and not at exactly its rate. Therefore the delays of successive pictures
    are added up, and small delays are forgotten within about ten pictures. A picture counts as missing if the sum is
    nearly a period.
    """

    def __init__(self, begin: float, rate: float) -> None:
        """Count from ``begin`` [s] on, for a camera of ``rate`` [Hz]."""
        self.count = 0
        self._rate, self._newest = rate, begin
        self._late: float | None = None  # The sum of delays at the newest picture, in periods; None before any picture.

    def add(self, time: float) -> int:
        """Take the time of the next picture [s]. Return how many pictures are missing just before it."""
        periods, self._newest = (time - self._newest) * self._rate, time
        # The first picture may come at any time within a period.
        late = periods if self._late is None else max(_REMEMBERS * self._late, -1.0) + periods - 1.0
        missing = max(int(late + (0.0 if self._late is None else _NEARLY)), 0)
        self._late = 0.0 if self._late is None else late - missing
        self.count += missing
        return missing

    def finish(self, end: float) -> None:
        """Count the pictures that are missing after the newest one, up to ``end`` [s]."""
        self.count += max(int((end - self._newest) * self._rate), 0)


class CameraWatch:
    """Watches one camera from the beginning of a run. Each fault is reported once, and again only if it comes back."""

    def __init__(self, name: str, camera: CameraConfig, begin: float) -> None:
        """``begin`` is the time of the run's first tick, by the clock of the pictures [s]."""
        self._name, self._camera = name, camera
        self._received = begin  # Time of receipt of the newest picture; at first, the time of the first tick [s].
        self._missing = MissingPictures(begin, camera.rate)
        self._times: deque[float] = deque()  # Times of the pictures of the last ``_WINDOW`` [s].
        self._told: set[ReasonKind] = set()

    @property
    def stopped(self) -> bool:
        """True if this watch has reported that the camera stopped, and no picture has come since."""
        return CameraReason.CAMERA_STOPPED in self._told

    @property
    def missing(self) -> int:
        """Number of pictures that were due and did not come."""
        return self._missing.count

    def add(self, time: float, received: float, width: int, height: int) -> list[Reason]:
        """Take a picture that was captured at ``time`` [s] and received at ``received`` [s]. Return what to report."""
        missing = self._missing.add(time)
        silence, self._received = received - self._received, received
        found = []
        if self.stopped:
            self._told.discard(CameraReason.CAMERA_STOPPED)
            self._times.clear()
            found.append(self._reason(CameraReason.CAMERA_BACK, gap=silence, missing=missing))
        wanted = self._camera.width, self._camera.height
        detail = {"width": width, "height": height, "allowed_width": wanted[0], "allowed_height": wanted[1]}
        found += self._tell(CameraReason.CAMERA_OTHER_SIZE, (width, height) != wanted, **detail)
        return found + self._rate_at(time)

    def look(self, now: float, why: str | None = None) -> list[Reason]:
        """Return what to report if no picture was received for too long a time before ``now`` [s].

        ``why`` is the camera's own reason, if it gives one.
        """
        age = now - self._received
        if self.stopped or age < longest_silence(self._camera):
            return []
        return self._tell(CameraReason.CAMERA_STOPPED, True, age=age, why=f": {why}" if why else "")

    def finish(self, end: float) -> None:
        """Count the pictures that are missing up to the last tick of the run, at ``end`` [s]."""
        self._missing.finish(end)

    def _rate_at(self, time: float) -> list[Reason]:
        self._times.append(time)
        span = time - self._times[0]
        if span < _WINDOW:
            return []
        rate = (len(self._times) - 1) / span
        self._times.popleft()
        share = rate / self._camera.rate
        if _SLOW <= share < _FAST_ENOUGH:  # Between the two shares, a slow camera still counts as slow.
            return []
        return self._tell(CameraReason.CAMERA_SLOW, share < _SLOW, rate=rate, due=self._camera.rate)

    def _tell(self, kind: ReasonKind, is_so: bool, **detail: Any) -> list[Reason]:
        """Return a reason of this ``kind`` if the fault is present (``is_so``) and was absent at the previous call."""
        was_told = kind in self._told
        (self._told.add if is_so else self._told.discard)(kind)
        return [self._reason(kind, **detail)] if is_so and not was_told else []

    def _reason(self, kind: ReasonKind, **detail: Any) -> Reason:
        return Reason.of(kind, camera=self._name, **detail)
