"""Which targets an arm may follow: only those of a stream that began where the arm was.

An arm follows a stream whose first target lies within ``engage_distance`` and ``engage_angle`` of the tool, as when an
operator engages. One that begins elsewhere is of a sender that does not know that the arm was stopped meanwhile. It is
refused as a whole, even where it later passes the tool. A stream begins with the first target ever, after a silence of
``timeout``, after a reset, and where refused targets jump to the tool. Then the operator engages again while targets go
on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pinocchio as pin

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.quaternions import Vector, floats_of, inverse, product, rotation_of, rotation_vector, se3_of
from q2r2_control.types import Pose

# A jump that no hand makes between two messages: a new stream begins [m], [rad].
_JUMP, _TURN = 0.05, 0.25


@dataclass(slots=True)
class StreamSettings:
    """The rules for a stream of targets; may be changed at run time."""

    timeout: float = STREAM_TIMEOUT  # [s]
    engage_distance: float = 0.03  # [m]
    engage_angle: float = 0.3  # [rad]
    linked: bool = True  # all arms hold when the targets of one cease, see TargetStreams


@dataclass(frozen=True, slots=True)
class Origins:
    """Who sends what, for messages about missing data: " from /node", or "" where that is not known.

    ``takers``: who takes an arm's commands, " /node", or "".
    """

    joint_states: Callable[[], str] = lambda: ""
    targets: Callable[[str], str] = lambda arm: ""
    takers: Callable[[str], str] = lambda arm: ""


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
        if self._last is None or now - self.stamp <= self._settings.timeout:
            return False
        was_following = self.following
        self.reset()
        return was_following

    def offer(self, pose: pin.SE3, tools: Sequence[pin.SE3], now: float) -> Reason | None:
        """Offer a target; returns why it is not followed, or None.

        ``tools`` are the poses that count as the tool's: the reference's, and the measured one where it is known. An
        arm that was pushed away from its reference is engaged where it is. An arm that follows a stream needs none.
        """
        self.expire(now)
        last, self._last, self.stamp = self._last, pose, now
        if self.following:
            self.pose = pose
            return None
        way, turn = (math.inf, math.inf) if last is None else apart(pose, last)
        begins = way >= _JUMP or turn >= _TURN
        # Position and rotation may each be near another one of the poses: an operator's first target has the
        # measured position and the commanded rotation.
        ways, turns = zip(*(apart(pose, tool) for tool in tools), strict=True)
        distance, angle = min(ways), min(turns)
        if begins and distance <= self._settings.engage_distance and angle <= self._settings.engage_angle:
            self.pose = pose
            return None
        return Reason.of(
            ReasonKind.STREAM_AWAY,
            distance=distance,
            angle=angle,
            engage_distance=self._settings.engage_distance,
            engage_angle=self._settings.engage_angle,
        )


def apart(a: pin.SE3, b: pin.SE3) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    difference = a.translation - b.translation
    way = float(math.sqrt(difference @ difference))
    cosine = 0.5 * (float((a.rotation * b.rotation).sum()) - 1.0)
    return way, math.acos(min(max(cosine, -1.0), 1.0))


# Between two targets of a line: slower ones are steps, and stamps that are nearer say nothing [s].
_SHORTEST, _LONGEST = 0.001, 0.025
_LOOKAHEAD = 2.5  # of the time between two: one may be left out, and the next one late
# Where the last target was not where the line led to, within this, it does not move evenly and is taken as it is.
_EVEN, _EVEN_TURN = 1.5e-3, 0.01  # [m], [rad]


class TargetExtrapolator:
    """The targets of one stream. Times are those at which targets are due [s]."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all targets; the next one begins a line."""
        self._pose: pin.SE3 | None = None
        self._due = -math.inf
        self._gap = 0.0
        self._at: Pose | None = None  # of the pose, where it is due at a known time
        self._twist: tuple[Vector, Vector] | None = None  # linear, and angular in the target's frame [m/s], [rad/s]
        self._even = False

    def put(self, pose: pin.SE3, due: float | None) -> None:
        """A target; ``due``: when it is to be reached, None where that is not known."""
        if due is None:
            self.reset()
            self._pose = pose
            return
        last, gap, twist = self._at, due - self._due, self._twist
        self._pose, self._due, self._at = pose, due, floats_of(pose)
        if 0.0 <= gap < _SHORTEST:
            return  # a late tick of its sender, and the next one
        self._twist, self._even = None, False
        if last is None or not _SHORTEST <= gap <= _LONGEST:
            return
        (x, y, z), rotation = self._at
        before, turned = last
        linear = (x - before[0]) / gap, (y - before[1]) / gap, (z - before[2]) / gap
        a, b, c = rotation_vector(product(inverse(turned), rotation))
        angular = a / gap, b / gap, c / gap
        if twist is not None:
            surprise, turn = gap * math.dist(linear, twist[0]), gap * math.dist(angular, twist[1])
            self._even = surprise <= _EVEN and turn <= _EVEN_TURN
        self._gap, self._twist = gap, (linear, angular)

    def at(self, t: float) -> pin.SE3 | None:
        """Where the target is at ``t`` [s]; None where there is none."""
        if self._at is None or self._twist is None or not self._even:
            return self._pose
        (x, y, z), rotation = self._at
        (dx, dy, dz), (a, b, c) = self._twist
        ahead = min(max(t - self._due, -self._gap), _LOOKAHEAD * self._gap)
        turned = product(rotation, rotation_of((ahead * a, ahead * b, ahead * c)))
        return se3_of(((x + ahead * dx, y + ahead * dy, z + ahead * dz), turned))
