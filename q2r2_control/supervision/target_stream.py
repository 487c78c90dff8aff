"""Which targets an arm may follow: only those of a stream that began where the arm was.

An arm follows a stream from its first target on, if that lies within ``engage_distance`` and ``engage_angle`` of the
tool, as it does when an operator engages. A stream that begins elsewhere comes from a sender that does not know that
the arm was stopped meanwhile. It is refused as a whole, even where it later passes the tool. A new stream begins with
the first target ever, after a silence of ``timeout``, after a reset, and where refused targets jump to the tool: that
is an operator who engages again while the targets never stop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pinocchio as pin

from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.events import Reason, ReasonKind

# A jump that no hand makes between two messages: a new stream begins [m], [rad].
_JUMP, _TURN = 0.05, 0.25


@dataclass(slots=True)
class StreamSettings:
    """What a stream of targets is; may be changed at run time."""

    timeout: float = STREAM_TIMEOUT  # [s]
    engage_distance: float = 0.03  # [m]
    engage_angle: float = 0.3  # [rad]
    linked: bool = True  # all arms hold when the targets of one cease, see TargetStreams


@dataclass(frozen=True, slots=True)
class Origins:
    """Who sends what, for messages about missing data: " from /node", or "" where that is not known."""

    joint_states: Callable[[], str] = lambda: ""
    targets: Callable[[str], str] = lambda arm: ""


class TargetStream:
    """The targets of one arm. Times are receipt times [s]."""

    def __init__(self, settings: StreamSettings) -> None:
        self._settings = settings
        self.pose: pin.SE3 | None = None  # followed; None: the arm holds
        self.stamp = -math.inf  # of the last target that was a pose
        self._last: pin.SE3 | None = None  # of the stream, followed or not; None: the next one begins a stream

    @property
    def following(self) -> bool:
        return self.pose is not None

    def reset(self) -> None:
        """Hold; the next target begins a stream."""
        self.pose = self._last = None

    def drop(self) -> None:
        """Hold; the stream that goes on now will not be followed any more."""
        self.pose = None

    def expire(self, now: float) -> bool:
        """Whether the stream that was followed has just run dry."""
        if self._last is None or self._is_recent(now):
            return False
        was_following = self.following
        self.reset()
        return was_following

    def _is_recent(self, now: float) -> bool:
        """Whether the last target came within the timeout."""
        return now - self.stamp <= self._settings.timeout

    def offer(self, pose: pin.SE3, tools: Sequence[pin.SE3], now: float) -> Reason | None:
        """Offer a target; returns why it is not followed, or None.

        ``tools`` are the poses that count as the tool's: the reference's, and the measured one where it is known. An
        arm that was pushed away from its reference is engaged where it is. An arm that follows a stream needs none.
        """
        if self.following and self._is_recent(now):
            self.pose, self._last, self.stamp = pose, pose, now
            return None
        self.expire(now)
        last, self._last, self.stamp = self._last, pose, now
        begins = _begins(pose, last)
        offsets = [apart(pose, tool) for tool in tools]
        # Position and rotation may each be near another one of the poses: an operator's first target has the
        # measured position and the commanded rotation.
        distance, angle = min(way for way, _ in offsets), min(turn for _, turn in offsets)
        near = distance <= self._settings.engage_distance and angle <= self._settings.engage_angle
        if begins and near:
            self.pose = pose
            return None
        return Reason.of(
            ReasonKind.STREAM_AWAY,
            distance=distance,
            angle=angle,
            engage_distance=self._settings.engage_distance,
            engage_angle=self._settings.engage_angle,
        )


def _begins(pose: pin.SE3, last: pin.SE3 | None) -> bool:
    if last is None:
        return True
    distance, angle = apart(pose, last)
    return distance >= _JUMP or angle >= _TURN


def apart(a: pin.SE3, b: pin.SE3) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    difference = a.translation - b.translation
    way = float(math.sqrt(difference @ difference))
    cosine = 0.5 * (float((a.rotation * b.rotation).sum()) - 1.0)
    return way, math.acos(min(max(cosine, -1.0), 1.0))
