"""The targets of all arms: who may send them, which stream of them is followed, and when one has ended."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pinocchio as pin

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.supervision.message_watch import SequenceWatch
from q2r2_control.supervision.target_stream import Origins, StreamSettings, TargetExtrapolator, TargetStream


class TargetStreams:
    """One :class:`TargetStream` an arm. Poses are in the world frame, times are receipt times [s].

    Linked arms (:attr:`StreamSettings.linked`) are stopped together: where a stream that is followed ceases, or is
    dropped because two nodes publish it, no arm follows its stream any more. Each needs a stream that begins anew at
    its tool. A stream that its sender ends with :meth:`release` stops its own arm only: its operator paused it.
    """

    def __init__(self, arms: Iterable[str], settings: StreamSettings, origins: Origins) -> None:
        self._settings, self._origins = settings, origins
        self._streams = {arm: TargetStream(settings) for arm in arms}
        self._lines = {arm: TargetExtrapolator() for arm in self._streams}
        self._sequences = {arm: SequenceWatch() for arm in self._streams}
        self.ended: dict[str, Reason] = {}  # arms that hold since their targets ended
        self._newly_ended: list[Reason] = []

    def at(self, now: float) -> dict[str, pin.SE3 | None]:
        """What each arm follows at ``now`` [s], see :class:`TargetExtrapolator`; None: it holds."""
        lines = self._lines
        return {arm: None if stream.pose is None else lines[arm].at(now) for arm, stream in self._streams.items()}

    @property
    def arms(self) -> tuple[str, ...]:
        """Names of all arms."""
        return tuple(self._streams)

    def follows(self, arm: str) -> bool:
        """Whether an arm follows its targets."""
        return self._streams[arm].following

    def follows_on(self, arm: str, now: float) -> bool:
        """Whether an arm follows its targets, and a target at ``now`` [s] still belongs to them."""
        self._expire(arm, now)
        return self._streams[arm].following

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

        ``tools``: see :meth:`TargetStream.offer`; ``number``: of the message at its publisher, None where that is not
        known; ``forbidden``: why no arm may follow targets now, or None; ``due``: see :meth:`TargetExtrapolator.put`.
        """
        stream = self._streams[arm]
        others = None if number is None else self._other_publishers(arm, number, now)
        if not stream.following:
            self._lines[arm].reset()
        refusal = None if pose is None else stream.offer(pose, tools, now)
        if others is not None:
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

    def _other_publishers(self, arm: str, number: int, now: float) -> Reason | None:
        """Says so where an arm's targets came from more than one publisher lately."""
        breaks = self._sequences[arm].take(number, now, self._settings.timeout)
        if breaks == 0:
            return None
        return self._reason(ReasonKind.PUBLISHER_CHANGED if breaks == 1 else ReasonKind.TWO_PUBLISHERS, arm)

    def _reason(self, kind: ReasonKind, arm: str) -> Reason:
        return Reason.of(kind, arm=arm, source=self._origins.targets(arm))
