"""Decide which targets an arm may follow: only the targets of a stream that began at the tool's pose.

An arm follows a stream whose first target lies within ``engage_distance`` and ``engage_angle`` of the tool, as it does
when an operator engages. A stream that begins elsewhere comes from a sender that does not know that the arm was stopped
meanwhile. Such a stream is refused as a whole, even if it passes the tool pose later.

A new stream begins with the first target, after a silence of ``timeout``, and after a reset. It also begins when the
targets of a refused stream jump to the tool: then the operator has engaged again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pinocchio as pin

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.events import Reason
from q2r2_control.quaternions import Vector, floats_of, inverse, product, rotation_of, rotation_vector, se3_of
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.types import Pose

# If the targets of a refused stream jump by at least this much, a new stream begins [m], [rad]. No hand moves so far
# between two messages.
_JUMP, _TURN = 0.05, 0.25


@dataclass(slots=True)
class StreamSettings:
    """The rules for a stream of targets; they may be changed at run time."""

    timeout: float = STREAM_TIMEOUT  # A stream ends if no target comes for longer than this [s].
    engage_distance: float = 0.03  # The first target of a stream must be at most this far from the tool [m].
    engage_angle: float = 0.3  # The first target must be turned from the tool by at most this angle [rad].
    linked: bool = True  # Whether all arms hold when the targets of one arm cease, see TargetStreams.


@dataclass(frozen=True, slots=True)
class Origins:
    """Names of senders and receivers for messages to the operator.

    Attributes:
        joint_states: Returns the sender of joint states as " from /node", or "" if it is not known.
        targets: Returns the sender of an arm's targets in the same form.
        takers: Returns the receiver of an arm's commands as " /node", or "".
    """

    joint_states: Callable[[], str] = lambda: ""
    targets: Callable[[str], str] = lambda arm: ""
    takers: Callable[[str], str] = lambda arm: ""


class TargetStream:
    """Follows or refuses the targets of one arm. All times are times of receipt [s]."""

    def __init__(self, settings: StreamSettings) -> None:
        self._settings = settings
        self.pose: pin.SE3 | None = None  # The target that the arm follows; None while the arm holds.
        self.stamp = -math.inf  # The time of the last target, whether it was followed or not.
        # The last target, whether it was followed or not. None if the next target begins a stream.
        self._last: pin.SE3 | None = None

    @property
    def following(self) -> bool:
        return self.pose is not None

    def reset(self) -> None:
        """Let the arm hold. The next target begins a new stream."""
        self.pose = self._last = None

    def drop(self) -> None:
        """Let the arm hold. The rest of the present stream is refused."""
        self.pose = None

    def expire(self, now: float) -> bool:
        """End the stream if its last target is older than the timeout; returns whether the arm followed it."""
        if self._last is None or now - self.stamp <= self._settings.timeout:
            return False
        was_following = self.following
        self.reset()
        return was_following

    def offer(self, pose: pin.SE3, tools: Callable[[], Sequence[pin.SE3]], now: float) -> Reason | None:
        """Take a target; returns why it is not followed, or None.

        The caller has ended the stream by :meth:`expire` if its targets have ceased.

        Args:
            pose: The target.
            tools: Returns the poses at which a stream may begin: the reference's tool, and the measured tool if it is
                known. With the measured tool, an arm that was pushed away from its reference can be engaged where it
                is. The function is not called while the arm follows a stream.
            now: The time of receipt [s].
        """
        last, self._last, self.stamp = self._last, pose, now
        if self.pose is not None:
            self.pose = pose
            return None
        moved, turn = (math.inf, math.inf) if last is None else apart(pose, last)
        begins = moved >= _JUMP or turn >= _TURN
        # The position may be near one of these poses, and the rotation near another one: an operator's first target
        # has the measured position and the commanded rotation.
        distances, turns = zip(*(apart(pose, tool) for tool in tools()), strict=True)
        distance, angle = min(distances), min(turns)
        if begins and distance <= self._settings.engage_distance and angle <= self._settings.engage_angle:
            self.pose = pose
            return None
        return Reason.of(
            SupervisionReason.STREAM_AWAY,
            distance=distance,
            angle=angle,
            engage_distance=self._settings.engage_distance,
            engage_angle=self._settings.engage_angle,
        )


def apart(a: pin.SE3, b: pin.SE3) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses."""
    difference = a.translation - b.translation
    distance = float(math.sqrt(difference @ difference))
    cosine = 0.5 * (float((a.rotation * b.rotation).sum()) - 1.0)
    return distance, math.acos(min(max(cosine, -1.0), 1.0))


# Times between two targets from which a velocity is computed [s]. A shorter time makes the velocity too inexact. After
# a longer time the targets are not extrapolated.
_SHORTEST, _LONGEST = 0.001, 0.025
_LOOKAHEAD = 2.5  # Targets are extrapolated for this many periods: one target may be lost, and the next one late.
# The target is extrapolated only if the last prediction was this exact [m], [rad].
_EVEN, _EVEN_TURN = 1.5e-3, 0.01


class TargetExtrapolator:
    """Extrapolates the targets of one stream while they move evenly.

    All times are times at which targets are due [s].
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all targets."""
        self._pose: pin.SE3 | None = None
        self._due = -math.inf
        self._gap = 0.0
        self._at: Pose | None = None  # The newest target as numbers, if it is due at a known time.
        # Linear velocity, and angular velocity in the target's frame [m/s], [rad/s].
        self._twist: tuple[Vector, Vector] | None = None
        self._even = False

    def put(self, pose: pin.SE3, due: float | None) -> None:
        """Take a target. ``due`` is the time at which the tool should reach it [s]; None if that is not known."""
        if due is None:
            self.reset()
            self._pose = pose
            return
        last, gap, twist = self._at, due - self._due, self._twist
        self._pose, self._due, self._at = pose, due, floats_of(pose)
        if 0.0 <= gap < _SHORTEST:
            return  # The sender was late with the last target, so the two targets give no velocity.
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
        """Return the target at time ``t`` [s]; None if there is no target."""
        if self._at is None or self._twist is None or not self._even:
            return self._pose
        (x, y, z), rotation = self._at
        (dx, dy, dz), (a, b, c) = self._twist
        ahead = min(max(t - self._due, -self._gap), _LOOKAHEAD * self._gap)
        turned = product(rotation, rotation_of((ahead * a, ahead * b, ahead * c)))
        return se3_of(((x + ahead * dx, y + ahead * dy, z + ahead * dz), turned))
