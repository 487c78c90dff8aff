"""The leash between a tool and its target. It bounds their distance if the tool cannot follow the target.

An arm that is stretched out or blocked cannot follow its hand. Without a leash the hand would have to come all the way
back before the arm moves again. If a target would go beyond the leash, the anchor of the relative motion shifts. The
target stays at the end of the leash, and the hand moves it from there. There is one leash for the position and one for
the rotation.

**Slack.** Suppose that a leash is taut, that the tool is blocked in the direction of the leash, and that the hand comes
back by more than its tremor. Then the target is put at the tool pose, and the tool follows the hand from there. The
unfiltered hand poses decide whether the hand comes back, because filtered poses swing back by millimetres when a hand
stops. The target's position and rotation are put at the tool pose together. While a tool is blocked, the pull towards
the target's position and the pull towards its rotation are in balance. If only one of the two were put at the tool
pose, the tool would follow the other one, by up to 50 mm.

**Why the arm does not jump.** The only state of the controller is its reference, which is at rest while the tool is
blocked. A target at the tool pose therefore asks for no motion. The controller also follows the velocity of its target,
but ignores a step that is faster than three times the tool's speed limit. Three times this limit is 9 m/s or 30 rad/s
at most. To put the target at the tool pose is a step. It is only done in a tick so short that this step is ignored.
"""

from __future__ import annotations

import math

from q2r2_control.config.teleop import LeashSettings, WorkspaceSettings
from q2r2_control.quaternions import Vector, turn_between, turned_by
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import Interval, Pose

# If the hand comes back by more than this, the target is put at the tool pose [m], [rad]. It is more than tremor, which
# is 0.2 mm and 0.2 degrees to either side, and more than the noise of a headset. This noise has a standard deviation of
# 0.2 mm and 0.03 degrees. Two samples of a hand at rest are at most about seven standard deviations apart.
_COMES_BACK = 1.5e-3, 12e-3
# A tool that is slower than this counts as blocked [m/s], [rad/s]. At this speed, a tool stops within a fraction of a
# millimetre.
_HELD_UP = 0.05, 0.2
# With any settings, a controller ignores the velocity of a target that steps faster than this [m/s], [rad/s].
_NO_MOTION = 10.0, 35.0
_ROUNDING = 1e-9  # Bound on the rounding error of a distance [m], and of a cosine.

# The data of one tick: the tool pose, the unslipped target (see ``Leash.target``), and the time [s].
_Tick = tuple[Pose, Pose, float]


class ComponentLeash:
    """The leash of a position or of a rotation. Displacements are vectors in the world frame [m or rad]."""

    def __init__(self, length: float | None, comes_back: float, held_up: float, no_motion: float) -> None:
        self._length = math.inf if length is None else length
        self._comes_back, self._held_up, self._no_motion = comes_back, held_up, no_motion
        self.reset()

    def reset(self) -> None:
        """Begin with a slack leash and no slip."""
        self.slip = 0.0  # The sum of all shifts of the target since the reset [m or rad].
        self.taut = False
        # Distance by which the hand has come back towards the tool since it was farthest away [m or rad].
        self._back = 0.0

    def releases_slack(self, shift: Vector, by_hand: Vector, by_tool: Vector, dt: float) -> bool:
        """Return whether the target is to be put at the tool pose, because the hand comes back from a blocked tool.

        Args:
            shift: Displacement from the tool to the target [m or rad].
            by_hand: How far the unfiltered hand would have moved the target since the last tick [m or rad], if no leash
                and no workspace had held the target back.
            by_tool: Motion of the tool since the last tick [m or rad].
            dt: Duration of the tick [s].
        """
        distance = math.hypot(*shift)
        # A taut leash stays taut until the distance is below half of its length. The tool has then caught up.
        self.taut = distance >= self._length or (self.taut and distance >= 0.5 * self._length)
        if not self.taut:
            self._back = 0.0
            return False
        self._back = max(0.0, self._back - _dot(shift, by_hand) / distance)
        held_up = abs(_dot(shift, by_tool)) < self._held_up * distance * dt
        return self._back > self._comes_back and held_up and distance > self._no_motion * dt

    def drop(self, shift: Vector) -> Vector:
        """Put the target at the tool pose: return the displacement 0, and count ``shift`` as slip."""
        self.taut, self._back = False, 0.0
        self.slip += math.hypot(*shift)
        return 0.0, 0.0, 0.0

    def hold(self, shift: Vector) -> Vector | None:
        """Return ``shift`` (from tool to target), cut to the leash's length; None if ``shift`` is not too long."""
        distance = math.hypot(*shift)
        if distance <= self._length:
            return None
        self.slip += distance - self._length
        share, (x, y, z) = self._length / distance, shift
        return share * x, share * y, share * z


class Leash:
    """Keeps the target of one arm near its tool. The module's docstring says how and why."""

    def __init__(self, settings: LeashSettings) -> None:
        limits = list(zip(_COMES_BACK, _HELD_UP, _NO_MOTION, strict=True))
        self.position = ComponentLeash(settings.distance, *limits[0])
        self.rotation = ComponentLeash(settings.angle, *limits[1])
        self._components = self.position, self.rotation
        # The leashes are computed only if the distance from the tool to the target is at least the first value, or if
        # the cosine of half the angle is at most the second value. Both values are slightly before the end of a leash.
        self._distance = math.inf if settings.distance is None else settings.distance - _ROUNDING
        self._cosine = -math.inf if settings.angle is None else math.cos(0.5 * settings.angle) + _ROUNDING
        self._last: _Tick | None = None

    def reset(self) -> None:
        """Begin with a slack leash and no slip, at a new anchor."""
        self.position.reset()
        self.rotation.reset()
        self._last = None

    def anchor_anew(self) -> None:
        """Forget the last tick, because the hand was anchored again at its present pose. The slip stays."""
        self._last = None

    def target(self, motion: RelativeMotion, hand: Pose, newest: Pose, tool: Pose, now: float) -> Pose:
        """Return the target pose (world frame) for ``hand``, no farther from the tool than the leashes allow.

        Args:
            motion: Maps the hand to its target. If a leash moves the target, ``motion`` is anchored again, so that the
                hand moves the target from there.
            hand: The filtered pose of the hand, in the input's frame.
            newest: The unslipped target (world frame). The unfiltered hand would have this target if no leash and no
                workspace had held a target back since the anchor.
            tool: The tool pose, in the world frame.
            now: The time [s].
        """
        target, last = motion.target_floats(hand), self._last
        self._last = this = tool, newest, now
        # The first target is the anchor. It must not move the arm, even if the tool is measured somewhere else.
        if last is None or not (self.position.taut or self.rotation.taut or self._ends(tool, target)):
            return target
        shift, turn = self._pull(target, last, this)
        position, rotation = target = _put(target, tool, shift, turn)
        if shift is not None:
            motion.anchor_position(hand[0], position)
        if turn is not None:
            motion.anchor_rotation(hand[1], rotation)
        return target

    def hold(self, target: Pose, tool: Pose) -> Pose:
        """Return ``target``, moved to be no farther from ``tool`` than the leashes allow. Both are in the world frame.

        The caller uses this for targets that no hand moves.
        """
        if not self._ends(tool, target):
            return target
        shift, turn = (
            component.hold(shift)
            for component, shift in zip(self._components, _displacements(tool, target), strict=True)
        )
        return _put(target, tool, shift, turn)

    def _ends(self, tool: Pose, target: Pose) -> bool:
        """Return whether the target has reached the maximum distance or angle from the tool.

        Targets rarely reach it, but all of them are checked. The check is therefore cheap.
        """
        (start, (a, b, c, d)), (end, (x, y, z, w)) = tool, target
        # The scalar product of two unit quaternions is the cosine of half the angle between them, up to its sign.
        return math.dist(start, end) >= self._distance or abs(a * x + b * y + c * z + d * w) <= self._cosine

    def _pull(self, target: Pose, last: _Tick, this: _Tick) -> list[Vector | None]:
        """Return the displacement and the rotation vector from the tool to the new target [m], [rad].

        The first one is None if the target's position stays, and the second one if its rotation stays.
        """
        (last_tool, last_newest, before), (tool, newest, now) = last, this
        displacements = _displacements(tool, target)
        moves = zip(
            self._components,
            displacements,
            _displacements(last_newest, newest),
            _displacements(last_tool, tool),
            strict=True,
        )
        # Both components are called, since each of them has to see every tick.
        dt = now - before
        releases = [leash.releases_slack(shift, by_hand, by_tool, dt) for leash, shift, by_hand, by_tool in moves]
        if any(releases):
            return [component.drop(shift) for component, shift in zip(self._components, displacements, strict=True)]
        return [component.hold(shift) for component, shift in zip(self._components, displacements, strict=True)]


def _displacements(start: Pose, end: Pose) -> tuple[Vector, Vector]:
    """Return the displacement [m] and the rotation vector [rad] from ``start`` to ``end``."""
    ((x, y, z), rotation), ((to_x, to_y, to_z), turned) = start, end
    return (to_x - x, to_y - y, to_z - z), turn_between(rotation, turned)


def _put(target: Pose, tool: Pose, shift: Vector | None, turn: Vector | None) -> Pose:
    """Return ``target``, put at ``shift`` and ``turn`` from the tool. None keeps the target's position or rotation."""
    (position, rotation), ((x, y, z), tool_rotation) = target, tool
    if shift is not None:
        position = x + shift[0], y + shift[1], z + shift[2]
    return position, rotation if turn is None else turned_by(tool_rotation, turn)


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


class Workspace:
    """Keeps the targets of one arm in a box.

    If the tool was outside of the box at the anchor, the targets may be equally far outside of it.
    """

    def __init__(self, settings: WorkspaceSettings | None) -> None:
        self._sides: tuple[Interval, ...] = () if settings is None else (settings.x, settings.y, settings.z)
        self.reset()

    def reset(self) -> None:
        """Begin at a new anchor. The next target is at the tool pose, which may be outside of the box."""
        self._bounds: list[Interval] | None = None
        self.slip = 0.0  # Length of the hand's motion that the targets have not followed since the reset [m].

    def hold(self, target: Pose) -> Vector | None:
        """Return the permitted position nearest to ``target`` (world frame) [m]; None if ``target`` is permitted.

        The caller anchors the motion at this position.
        """
        asked = target[0]
        if self._bounds is None:
            self._bounds = [(min(side[0], at), max(side[1], at)) for side, at in zip(self._sides, asked, strict=False)]
        allowed = self.clip(asked)
        if allowed == asked:
            return None
        self.slip += math.dist(allowed, asked)
        return allowed

    def clip(self, position: Vector) -> Vector:
        """Return the permitted position that is nearest to ``position`` (world frame) [m]."""
        if not self._bounds:
            return position
        x, y, z = (min(max(at, least), greatest) for (least, greatest), at in zip(self._bounds, position, strict=True))
        return x, y, z
