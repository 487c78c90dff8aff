"""Take the targets of all arms: find late messages and second publishers, and decide which streams are followed."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import pinocchio as pin

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.target_stream import Origins, StreamSettings, TargetExtrapolator, TargetStream

# The usual delay may grow by this much per second [s/s]. The clocks of two hosts drift apart more slowly, and the delay
# of a frozen sender grows much faster.
_DRIFT = 1e-3
_CLOCK_WAS_SET = 1.0  # If all messages are late for longer than this, a clock was set [s].


class DelayWatch:
    """Finds late messages of one topic, which must not move an arm. All times are times of receipt [s].

    If the process of a sender is frozen while it sends a target, the target leaves when the process wakes up, and is
    old by then. The delay of a message is the time of receipt minus the time of sending. The two times may come from
    the clocks of different hosts, so only the change of the delay counts.
    """

    def __init__(self, allowed: float) -> None:
        """``allowed`` is how much longer than usual a message may take [s]."""
        self._allowed = allowed
        self.usual = math.inf  # The least delay so far, corrected for the drift of the clocks [s].
        self._stamp, self._late_since = 0.0, math.inf

    def take(self, delay: float, now: float) -> float:
        """Return the time by which a message is too late [s]; 0 if it is in time or if its delay is not known.

        Args:
            delay: Time of receipt minus time of sending [s]; not finite if it is not known.
            now: Time of receipt [s].
        """
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


# No publisher sends more often than _MAX_RATE_HZ, and no message takes longer than _MAX_DELIVERY_S. If sequence numbers
# grow faster, they come from another publisher.
_MAX_RATE_HZ, _MAX_DELIVERY_S = 2000.0, 0.1
_ALONE = 1.0  # A break in the sequence counts as recent for this time [s].


class SequenceWatch:
    """Finds a second publisher by the sequence numbers of one topic. All times are times of receipt [s].

    A break in the sequence is a number that cannot come from the publisher of the previous number.
    """

    def __init__(self) -> None:
        self._number, self._stamp = 0, -math.inf
        self._breaks: deque[float] = deque()

    def take(self, number: int, now: float, timeout: float) -> int:
        """Take the sequence number of a message. Return the number of recent breaks in the sequence.

        The count is 0 for a single publisher and 1 for a publisher that replaced another one. Two breaks or more show
        two publishers that take turns. After a silence of ``timeout`` the numbers may begin anywhere, because a
        publisher that was restarted counts from one.
        """
        passed = now - self._stamp
        if passed <= timeout and not 0 < number - self._number <= 1 + _MAX_RATE_HZ * (passed + _MAX_DELIVERY_S):
            self._breaks.append(now)
        self._number, self._stamp = number, now
        while self._breaks and now - self._breaks[0] > _ALONE:
            self._breaks.popleft()
        return len(self._breaks)


class TargetStreams:
    """Contains one :class:`TargetStream` for each arm.

    Poses are in the world frame. All times are times of receipt [s].

    Linked arms (:attr:`StreamSettings.linked`) stop together. If the targets of one arm cease, or two nodes publish
    them, then every arm needs a new stream that begins at its tool. An operator who pauses one arm ends its stream by
    :meth:`release`, which stops this arm only.
    """

    def __init__(self, arms: Iterable[str], settings: StreamSettings, origins: Origins) -> None:
        self._settings, self._origins = settings, origins
        self._streams = {arm: TargetStream(settings) for arm in arms}
        self._lines = {arm: TargetExtrapolator() for arm in self._streams}
        self._sequences = {arm: SequenceWatch() for arm in self._streams}
        self.ended: dict[str, Reason] = {}  # For each arm that holds because its targets ended, the reason.
        self._newly_ended: list[Reason] = []

    def at(self, now: float) -> dict[str, pin.SE3 | None]:
        """Return the target that each arm follows at ``now`` [s]; None if the arm holds.

        Between two messages, targets are extrapolated, see :class:`TargetExtrapolator`.
        """
        return {arm: None if stream.pose is None else self._lines[arm].at(now) for arm, stream in self._streams.items()}

    def follows(self, arm: str) -> bool:
        return self._streams[arm].following

    def age(self, arm: str, now: float) -> float:
        """Return the time since an arm's last valid target, followed or not [s]."""
        return now - self._streams[arm].stamp

    def offer(
        self,
        arm: str,
        pose: pin.SE3 | None,
        tools: Callable[[], Sequence[pin.SE3]],
        now: float,
        number: int | None,
        forbidden: Reason | None,
        due: float | None = None,
    ) -> Reason | None:
        """Take a target of one arm; returns why it is not followed, or None.

        Args:
            arm: The arm.
            pose: The target; None if the message was not a pose.
            tools: See :meth:`TargetStream.offer`.
            now: The time of receipt [s].
            number: The sequence number that the publisher gave the message; None if it is unknown.
            forbidden: Why no arm may follow targets now; None if arms may follow targets.
            due: See :meth:`TargetExtrapolator.put`.
        """
        self._expire(arm, now)
        stream = self._streams[arm]
        breaks = 0 if number is None else self._sequences[arm].take(number, now, self._settings.timeout)
        if stream.pose is None:
            self._lines[arm].reset()
        refusal = None if pose is None else stream.offer(pose, tools, now)
        if breaks:
            others = self._reason(
                SupervisionReason.PUBLISHER_CHANGED if breaks == 1 else SupervisionReason.TWO_PUBLISHERS, arm
            )
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
        """Let the arm hold because its sender ended the stream. The next target begins a new stream."""
        self._streams[arm].reset()

    def end(self, why: Reason) -> None:
        """Let all arms hold, for a reason that is shown until they follow targets again."""
        self.ended |= dict.fromkeys(self._streams, why)
        self.drop()

    def drop(self) -> None:
        """Let all arms hold, and refuse the rest of the present streams."""
        for stream in self._streams.values():
            stream.drop()

    def reset(self) -> None:
        """Let all arms hold. The next target of each arm begins a new stream."""
        self.ended.clear()
        for stream in self._streams.values():
            stream.reset()

    def expire(self, now: float) -> list[Reason]:
        """End the streams whose targets have ceased. Return a reason for each stream that has newly ended."""
        for arm in self._streams:
            self._expire(arm, now)
        ended, self._newly_ended = self._newly_ended, []
        return ended

    def _expire(self, arm: str, now: float) -> None:
        """End the arm's stream if its targets have ceased."""
        if self._streams[arm].expire(now):
            self._record_end(arm, self._reason(SupervisionReason.TARGETS_CEASED, arm))
            self._hold_linked(arm, self.ended[arm])

    def _hold_linked(self, ended: str, why: Reason) -> None:
        """Let the other linked arms hold as well: one operator moves all arms, and expects no arm to go on alone."""
        for arm, stream in self._streams.items():
            if self._settings.linked and arm != ended and stream.following:
                stream.drop()
                self._record_end(arm, Reason.of(SupervisionReason.TARGETS_LINKED, cause=why, arm=arm, other=ended))

    def _record_end(self, arm: str, reason: Reason) -> None:
        self.ended[arm] = reason
        self._newly_ended.append(reason)

    def _reason(self, kind: ReasonKind, arm: str) -> Reason:
        return Reason.of(kind, arm=arm, source=self._origins.targets(arm))
