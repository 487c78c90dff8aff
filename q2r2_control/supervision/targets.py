"""The targets of all arms: who may send them, which come too late, which stream is followed, and when it has ended."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence

import pinocchio as pin

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.supervision.target_stream import Origins, StreamSettings, TargetExtrapolator, TargetStream

# The usual delay may grow this fast: clocks of two hosts drift apart by less, and a frozen sender's delay by far more.
_DRIFT = 1e-3
_CLOCK_WAS_SET = 1.0  # messages that are late for longer show a clock that was set [s]


class DelayWatch:
    """Finds messages of one topic that tell of the past, and must not move an arm. Times are receipt times [s].

    A sender that is frozen in the middle of sending finishes when it goes on: a target of long ago leaves. A delay is
    the time of receipt less that of sending, on clocks that may be of two hosts: only its change counts.
    """

    def __init__(self, allowed: float) -> None:
        """``allowed``: how much longer than usual a message may take [s]."""
        self._allowed = allowed
        self.usual = math.inf  # the least delay of the past, which clocks that drift apart may change [s]
        self._stamp, self._late_since = 0.0, math.inf

    def take(self, delay: float, now: float) -> float:
        """How much too late [s] a message is that came at ``now`` with ``delay`` [s]; 0 also where that is unknown."""
        if not math.isfinite(delay):
            return 0.0
        usual = self.usual + _DRIFT * max(now - self._stamp, 0.0)
        if now - self._late_since > _CLOCK_WAS_SET:
            usual = math.inf
        if delay - usual <= self._allowed:
            self.usual, self._stamp, self._late_since = min(delay, usual), now, math.inf
            return 0.0
        self._late_since = min(self._late_since, now)
        return delay - usual


# No publisher sends faster, and none is delivered later than that: a larger step is another one's [Hz], [s].
_FASTEST, _LATEST = 2000.0, 0.1
_ALONE = 1.0  # after the last break a stream counts as one publisher's again [s]


class SequenceWatch:
    """The numbers of one topic's messages. Times are receipt times [s]."""

    def __init__(self) -> None:
        self._number, self._stamp = 0, -math.inf
        self._breaks: deque[float] = deque()

    def take(self, number: int, now: float, timeout: float) -> int:
        """Look at a message's number; returns the number of recent breaks, 0 for a single publisher.

        After a silence of ``timeout`` numbers may begin anywhere: a publisher that was restarted counts from one. One
        break is a publisher that replaced another, two are two that take turns.
        """
        passed = now - self._stamp
        if passed <= timeout and not 0 < number - self._number <= 1 + _FASTEST * (passed + _LATEST):
            self._breaks.append(now)
        self._number, self._stamp = number, now
        while self._breaks and now - self._breaks[0] > _ALONE:
            self._breaks.popleft()
        return len(self._breaks)


class TargetStreams:
    """One :class:`TargetStream` an arm. Poses are in the world frame, times are receipt times [s].

    Linked arms (:attr:`StreamSettings.linked`) are stopped together. Where a stream that is followed ceases, or is
    dropped because two nodes publish it, every arm needs a stream that begins anew at its tool. A stream that its
    sender ends with :meth:`release` stops its own arm only: its operator paused it.
    """

    def __init__(self, arms: Iterable[str], settings: StreamSettings, origins: Origins) -> None:
        self._settings, self._origins = settings, origins
        self._streams = {arm: TargetStream(settings) for arm in arms}
        self._lines = {arm: TargetExtrapolator() for arm in self._streams}
        self._sequences = {arm: SequenceWatch() for arm in self._streams}
        self.ended: dict[str, Reason] = {}  # arms that hold since their targets ended
        self._newly_ended: list[Reason] = []

    def at(self, now: float) -> dict[str, pin.SE3 | None]:
        """The target that each arm follows at ``now`` [s], see :class:`TargetExtrapolator`; None: it holds."""
        return {arm: self._lines[arm].at(now) if self.follows(arm) else None for arm in self._streams}

    def follows(self, arm: str) -> bool:
        return self._streams[arm].following

    def follows_on(self, arm: str, now: float) -> bool:
        """Whether an arm follows its targets, and a target at ``now`` [s] still belongs to them."""
        self._expire(arm, now)
        return self.follows(arm)

    def age(self, arm: str, now: float) -> float:
        """Time since the last target of an arm that was a pose [s]."""
        return now - self._streams[arm].stamp

    def offer(
        self,
        arm: str,
        pose: pin.SE3 | None,
        tools: Sequence[pin.SE3],
        now: float,
        number: int | None,
        forbidden: Reason | None,
        due: float | None = None,
    ) -> Reason | None:
        """Offer a target, None for one that was no pose; returns why it is not followed, or None.

        ``tools``: see :meth:`TargetStream.offer`; ``number``: of the message at its publisher, where known;
        ``forbidden``: why no arm may follow targets now; ``due``: see :meth:`TargetExtrapolator.put`.
        """
        stream = self._streams[arm]
        breaks = 0 if number is None else self._sequences[arm].take(number, now, self._settings.timeout)
        if not stream.following:
            self._lines[arm].reset()
        refusal = None if pose is None else stream.offer(pose, tools, now)
        if breaks:
            others = self._reason(ReasonKind.PUBLISHER_CHANGED if breaks == 1 else ReasonKind.TWO_PUBLISHERS, arm)
            if stream.following:
                self._hold_linked(arm, others)
            stream.drop()
            return others
        if pose is None:
            return None
        if forbidden is not None:
            stream.drop()
            return forbidden
        if refusal is None:
            self._lines[arm].put(pose, due)
            self.ended.pop(arm, None)
        return refusal

    def release(self, arm: str) -> None:
        """The sender ended the arm's stream: it holds, and the next target begins a stream."""
        self._streams[arm].reset()

    def end(self, why: Reason) -> None:
        """All arms hold, for a reason that is told until they follow again."""
        self.ended |= dict.fromkeys(self._streams, why)
        self.drop()

    def drop(self) -> None:
        """All arms hold, and the streams that go on now are not followed any more."""
        for stream in self._streams.values():
            stream.drop()

    def reset(self) -> None:
        """All arms hold, and the next target of each begins a stream."""
        self.ended.clear()
        for stream in self._streams.values():
            stream.reset()

    def expire(self, now: float) -> list[Reason]:
        """One for each arm that followed its targets and holds since the last call because targets ceased."""
        for arm in self._streams:
            self._expire(arm, now)
        ended, self._newly_ended = self._newly_ended, []
        return ended

    def _expire(self, arm: str, now: float) -> None:
        """End the arm's stream if it has run dry."""
        if self._streams[arm].expire(now):
            self._record_end(arm, self._reason(ReasonKind.TARGETS_CEASED, arm))
            self._hold_linked(arm, self.ended[arm])

    def _hold_linked(self, ended: str, why: Reason) -> None:
        """The arms that follow targets hold as well: one operator moves all, and does not expect one to go on alone."""
        for arm, stream in self._streams.items():
            if self._settings.linked and arm != ended and stream.following:
                stream.drop()
                self._record_end(arm, Reason.of(ReasonKind.TARGETS_LINKED, cause=why, arm=arm, other=ended))

    def _record_end(self, arm: str, reason: Reason) -> None:
        self.ended[arm] = reason
        self._newly_ended.append(reason)

    def _reason(self, kind: ReasonKind, arm: str) -> Reason:
        return Reason.of(kind, arm=arm, source=self._origins.targets(arm))
