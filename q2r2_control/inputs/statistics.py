"""Statistics of a headset connection, for people: counts, rates, ages, last values, reasons."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from q2r2_control.inputs.messages import Dialect, HandMessage

RATE_WINDOW = 1.0  # [s]
_STAMPS_KEPT = 1000  # more than any headset sends in RATE_WINDOW


@dataclass(frozen=True, slots=True)
class TopicStatistics:
    """One topic of the app since it connected."""

    count: int
    rate: float  # messages in the last second [Hz]
    age: float  # since the last message [s]
    last: HandMessage


@dataclass(frozen=True, slots=True)
class HeadsetStatistics:
    """A snapshot of the server. After a disconnect, dialect and topics are those of the last connection."""

    address: tuple[str, int]  # bound host and port
    peer: str | None  # host:port of the connected headset
    dialect: Dialect | None
    topics: dict[str, TopicStatistics]
    unknown_topics: dict[str, int]  # data that nothing here reads, by topic
    published: tuple[str, ...]  # topics that the app announced
    subscribed: tuple[str, ...]  # topics that the app listens to
    connections: int  # since the server was started
    last_disconnect: str | None  # reason


class Arrivals:
    """Counts the messages of one topic. Times are receipt times [s]."""

    def __init__(self) -> None:
        self._stamps: deque[float] = deque(maxlen=_STAMPS_KEPT)
        self.count = 0

    def note(self, now: float) -> None:
        """A message has come."""
        self._stamps.append(now)
        self.count += 1

    def rate(self, now: float) -> float:
        """Messages in the last second [Hz]."""
        return sum(stamp > now - RATE_WINDOW for stamp in self._stamps) / RATE_WINDOW

    def age(self, now: float) -> float:
        """Time since the last message [s]; infinite before the first."""
        return now - self._stamps[-1] if self._stamps else math.inf


class TopicRecorder(Arrivals):
    """Counts the messages of one topic, and keeps the last."""

    _last: HandMessage

    def record(self, message: HandMessage, now: float) -> None:
        self.note(now)
        self._last = message

    def snapshot(self, now: float) -> TopicStatistics:
        """The figures at ``now`` [s]; only after the first :meth:`record`."""
        return TopicStatistics(self.count, self.rate(now), self.age(now), self._last)
