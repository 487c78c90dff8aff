"""The hands of one headset at a time: from its messages to samples for the loop, and to figures for people."""

from __future__ import annotations

import threading
from collections.abc import Callable

from q2r2_control.inputs.samples import HandsWatch, HandTracker, SampleQueue, Watched
from q2r2_control.inputs.session import HeadsetStatistics, Reception, TopicRecorder
from q2r2_control.types import HandSample


class HandStream:
    """The same way for the messages of every headset, however it is connected.

    One thread calls :meth:`admit`, :meth:`receive` and :meth:`lose`; the loop's calls :meth:`take` and never waits.
    """

    def __init__(self, watch: HandsWatch, tell: Callable[[Watched], None] | None = None) -> None:
        """``watch`` finds poses that must not be followed; ``tell`` gets each message instead of the loop."""
        self._watch, self._tell = watch, tell
        self._samples, self._tracker = SampleQueue(), HandTracker()
        self._lock = threading.Lock()  # of the figures
        self._recorders: dict[str, TopicRecorder] = {}
        self.peer: str | None = None  # that drives
        self._connections = 0
        self._last_disconnect: str | None = None

    @property
    def connected(self) -> bool:
        """Whether a headset drives, and no loss is left that :meth:`take` has not shown yet."""
        return self.peer is not None and not self._samples.is_cut

    def admit(self, peer: str) -> None:
        """A headset drives from now on; nothing of an earlier one counts."""
        self._watch.reset()
        self._tracker = HandTracker()
        with self._lock:
            self._recorders = {}
            self._connections += 1
            self.peer = peer

    def lose(self, reason: str) -> None:
        """The headset that drove is gone."""
        self._samples.cut()  # before the peer, so that `connected` cannot be true of the next one too early
        with self._lock:
            self.peer, self._last_disconnect = None, reason

    def receive(self, reception: Reception, now: float) -> None:
        """A message of the headset that drives, received at ``now`` [s]."""
        with self._lock:
            self._recorders.setdefault(reception.topic, TopicRecorder()).record(reception.message, now)
        for watched in self._watch.receive(reception, now):
            hand, message = watched.reception.hand, watched.reception.message
            if self._tell is not None:
                self._tell(watched)
            elif (sample := self._tracker.update(hand, message, watched.stamp, watched.fault)) is not None:
                self._samples.put(sample)

    def take(self) -> list[HandSample]:
        """Samples since the last time, oldest first. None of a lost connection: those poses are not the hand's."""
        return self._samples.take()

    def statistics(self, address: tuple[str, int], now: float) -> HeadsetStatistics:
        """A snapshot for people, of a server at ``address``."""
        with self._lock:
            return HeadsetStatistics(
                address=address,
                peer=self.peer,
                dialect=None,
                topics={name: recorder.snapshot(now) for name, recorder in self._recorders.items()},
                unknown_topics={},
                published=(),
                subscribed=(),
                connections=self._connections,
                last_disconnect=self._last_disconnect,
            )
