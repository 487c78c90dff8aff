"""Turn the messages of the headset that drives into samples for the loop, and into statistics for people."""

from __future__ import annotations

import threading
from collections.abc import Callable

from q2r2_control.inputs.samples import HandsWatch, HandTracker, SampleQueue, Watched
from q2r2_control.inputs.session import HeadsetStatistics, Reception, TopicRecorder
from q2r2_control.types import HandSample


class HandStream:
    """Handles the messages of every headset in the same way, however the headset is connected.

    One thread calls :meth:`admit`, :meth:`receive` and :meth:`lose`. The loop's thread calls :meth:`take`, and never
    waits.
    """

    def __init__(self, watch: HandsWatch, tell: Callable[[Watched], None] | None = None) -> None:
        """Make a stream.

        Args:
            watch: Finds poses that must not be followed.
            tell: Gets each message. If it is given, no samples are queued for the loop.
        """
        self._watch, self._tell = watch, tell
        self._samples, self._tracker = SampleQueue(), HandTracker()
        self._lock = threading.Lock()  # Protects the statistics.
        self._recorders: dict[str, TopicRecorder] = {}
        self.peer: str | None = None  # The headset that drives; None if there is none.
        self._connections = 0
        self._last_disconnect: str | None = None

    @property
    def connected(self) -> bool:
        """Whether a headset is connected and sends hand data.

        After a lost connection it stays False until :meth:`take` has noticed the loss.
        """
        return self.peer is not None and not self._samples.is_cut

    def admit(self, peer: str) -> None:
        """Let a headset drive from now on, and forget all data of an earlier headset."""
        self._watch.reset()
        self._tracker = HandTracker()
        with self._lock:
            self._recorders = {}
            self._connections += 1
            self.peer = peer

    def lose(self, reason: str) -> None:
        """Note that the connection of the headset that drove is lost."""
        # The queue is cut before the peer changes. Otherwise `connected` could be True for the next headset too early.
        self._samples.cut()
        with self._lock:
            self.peer, self._last_disconnect = None, reason

    def receive(self, reception: Reception, now: float) -> None:
        """Take a message of the headset that drives, received at ``now`` [s]."""
        with self._lock:
            self._recorders.setdefault(reception.topic, TopicRecorder()).record(reception.message, now)
        for watched in self._watch.receive(reception, now):
            hand, message = watched.reception.hand, watched.reception.message
            if self._tell is not None:
                self._tell(watched)
            elif (sample := self._tracker.update(hand, message, watched.stamp, watched.fault)) is not None:
                self._samples.put(sample)

    def take(self) -> list[HandSample]:
        """Return the samples since the previous call, oldest first. Samples of a lost connection are left out."""
        return self._samples.take()

    def statistics(self, address: tuple[str, int], now: float) -> HeadsetStatistics:
        """Return a snapshot for people at ``now`` [s]. ``address`` is the host and port of the server."""
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
