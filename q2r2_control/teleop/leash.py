"""The leash between a tool and its target: it bounds how far a target gets from a tool that cannot follow.

An arm that is stretched out or blocked cannot follow its hand. Without a leash the hand would have to come all the way
back before the arm moves again. Where a target would go beyond the leash, the anchor of the relative motion shifts. The
target stays where the leash ends and the hand moves it from there. Position and rotation have a leash each.

**Slack.** A leash is taut, the tool is blocked in its direction, and the hand comes back by more than tremor. Then the
target is put at the tool, which follows the hand from there. Whether the hand comes back is read from its unfiltered
poses: when a hand stops, the filtered ones swing back by millimetres. Position and rotation are put there together. A
blocked tool rests where the pulls of both balance, and would follow the one that is left, up to 50 mm.

**Why the arm does not jump.** The only state of the controller is its reference, which is at rest while the tool is
blocked. A target at the tool therefore asks for no motion. The controller also follows its target's own velocity, but
not that of a step faster than three times the tool's limit, 9 m/s or 30 rad/s at most. Slack is dropped in a tick that
is short enough to make such a step.
"""

from __future__ import annotations

import math

from q2r2_control.config.teleop import LeashSettings, WorkspaceSettings
from q2r2_control.quaternions import Vector, turn_between, turned_by
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import Interval, Pose

# The way back that drops the slack: more than tremor, 0.2 mm and 0.2 degrees to either side, and a headset's noise. Of
# the noise seven times 0.2 mm and 0.03 degrees lie between the farthest samples of a hand that rests.
_WAY_BACK = 1.5e-3, 12e-3  # [m, rad]
_HELD_UP = 0.05, 0.2  # a slower tool counts as blocked; it stops within a fraction of a millimetre [m/s, rad/s]
_NO_MOTION = 10.0, 35.0  # a faster step is no motion of a target, whatever the controller's settings [m/s, rad/s]
_ROUNDING = 1e-9  # [m], and of a cosine

_Tick = tuple[Pose, Pose, float]  # the tool, the newest hand and the time [s], which the next tick looks at


class ComponentLeash:
    """The leash of a position or of a rotation; displacements are vectors in the world frame [m or rad]."""

    def __init__(self, length: float | None, way_back: float, held_up: float, no_motion: float) -> None:
        self._length = math.inf if length is None else length
        self._way_back, self._held_up, self._no_motion = way_back, held_up, no_motion
        self.reset()

    def reset(self) -> None:
        """Slack, nothing slipped."""
        self.slip = 0.0  # how far the target has slipped since then, to and fro counted [m or rad]
        self.taut = False
        self._back = 0.0  # of the hand, since it was farthest

    def releases_slack(self, way: Vector, by_hand: Vector, by_tool: Vector, dt: float) -> bool:
        """Whether to drop the slack.

        ``way``: from the tool to the target; ``by_hand``, ``by_tool``: of the unfiltered hand and the tool in ``dt``.
        """
        distance = math.hypot(*way)
        # Below half of the length the tool has followed by itself.
        self.taut = distance >= self._length or (self.taut and distance >= 0.5 * self._length)
        if not self.taut:
            self._back = 0.0
            return False
        self._back = max(0.0, self._back - _dot(way, by_hand) / distance)
        held_up = abs(_dot(way, by_tool)) < self._held_up * distance * dt
        return self._back > self._way_back and held_up and distance > self._no_motion * dt

    def drop(self, way: Vector) -> Vector:
        self.taut, self._back = False, 0.0
        self.slip += math.hypot(*way)
        return 0.0, 0.0, 0.0

    def hold(self, way: Vector) -> Vector | None:
        """The way to a target that the leash holds; None: the leash is not taut."""
        distance = math.hypot(*way)
        if distance <= self._length:
            return None
        self.slip += distance - self._length
        share, (x, y, z) = self._length / distance, way
        return share * x, share * y, share * z


class Leash:
    """Keeps one arm's target near its tool; see the module's text. Starts slack at every :meth:`reset`."""

    def __init__(self, settings: LeashSettings) -> None:
        limits = list(zip(_WAY_BACK, _HELD_UP, _NO_MOTION, strict=True))
        self.position = ComponentLeash(settings.distance, *limits[0])
        self.rotation = ComponentLeash(settings.angle, *limits[1])
        self._components = self.position, self.rotation
        # A little less than the leash's, so that it is looked at in time; of the angle, the cosine of half of it.
        self._distance = math.inf if settings.distance is None else settings.distance - _ROUNDING
        self._cosine = -math.inf if settings.angle is None else math.cos(0.5 * settings.angle) + _ROUNDING
        self._last: _Tick | None = None

    def reset(self) -> None:
        """Slack, nothing slipped: for a new anchor."""
        self.position.reset()
        self.rotation.reset()
        self._last = None

    def anchor_anew(self) -> None:
        """The hand was anchored anew where it is, its way since the last tick is not known; the slip stays."""
        self._last = None

    def target(self, motion: RelativeMotion, hand: Pose, newest: Pose, tool: Pose, now: float) -> Pose:
        """The target of ``hand`` at ``now`` [s], no farther from ``tool`` (world frame) than the leash reaches.

        ``newest`` is where the unfiltered hand would have the tool if nothing had ever slipped. Where the leash pulls,
        ``motion`` is anchored anew, so that the hand moves the target from there.
        """
        target, last = motion.target_floats(hand), self._last
        self._last = this = tool, newest, now
        # The first target is the anchor, which must not move the arm wherever the plant says the tool is.
        if last is None or not (self.position.taut or self.rotation.taut or self._ends(tool, target)):
            return target
        way, turn = self._pull(target, last, this)
        position, rotation = target = _put(target, tool, way, turn)
        if way is not None:
            motion.anchor_position(hand[0], position)
        if turn is not None:
            motion.anchor_rotation(hand[1], rotation)
        return target

    def hold(self, target: Pose, tool: Pose) -> Pose:
        """A target that no hand moves, no farther from ``tool`` (world frame) than the leash reaches."""
        if not self._ends(tool, target):
            return target
        way, turn = (component.hold(way) for component, way in zip(self._components, _ways(tool, target), strict=True))
        return _put(target, tool, way, turn)

    def _ends(self, tool: Pose, target: Pose) -> bool:
        """Whether the target is as far as a leash reaches, told with little work: at most ticks it is not."""
        (start, (a, b, c, d)), (end, (x, y, z, w)) = tool, target
        # Of two unit quaternions the scalar product is the cosine of half the angle between them, but for its sign.
        return math.dist(start, end) >= self._distance or abs(a * x + b * y + c * z + d * w) <= self._cosine

    def _pull(self, target: Pose, last: _Tick, this: _Tick) -> list[Vector | None]:
        """Ways from the tool to the target's new position and rotation, None for what the leash leaves alone."""
        (last_tool, last_newest, before), (tool, newest, now) = last, this
        ways = _ways(tool, target)
        moves = zip(self._components, ways, _ways(last_newest, newest), _ways(last_tool, tool), strict=True)
        # All are asked, since each component has to see every tick.
        dt = now - before
        releases = [leash.releases_slack(way, by_hand, by_tool, dt) for leash, way, by_hand, by_tool in moves]
        if any(releases):
            return [component.drop(way) for component, way in zip(self._components, ways, strict=True)]
        return [component.hold(way) for component, way in zip(self._components, ways, strict=True)]


def _ways(start: Pose, end: Pose) -> tuple[Vector, Vector]:
    ((x, y, z), rotation), ((to_x, to_y, to_z), turned) = start, end
    return (to_x - x, to_y - y, to_z - z), turn_between(rotation, turned)


def _put(target: Pose, tool: Pose, way: Vector | None, turn: Vector | None) -> Pose:
    """The target at this way and turn from the tool; None: where it is."""
    (position, rotation), ((x, y, z), tool_rotation) = target, tool
    if way is not None:
        position = x + way[0], y + way[1], z + way[2]
    return position, rotation if turn is None else turned_by(tool_rotation, turn)


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


class Workspace:
    """Keeps one arm's targets in its box, or no farther out than its tool was at the anchor; None: there is no box."""

    def __init__(self, settings: WorkspaceSettings | None) -> None:
        self._sides: tuple[Interval, ...] = () if settings is None else (settings.x, settings.y, settings.z)
        self.reset()

    def reset(self) -> None:
        """For a new anchor: the next target is where the tool is, wherever that may be."""
        self._bounds: list[Interval] | None = None
        self.slip = 0.0  # how much of the hand's way was not made since the reset [m]

    def hold(self, target: Pose) -> Vector | None:
        """The position, world frame, that ``target`` may have and the hand is to be anchored to; None: its own."""
        asked = target[0]
        if self._bounds is None:
            self._bounds = [(min(side[0], at), max(side[1], at)) for side, at in zip(self._sides, asked, strict=False)]
        allowed = self.clip(asked)
        if allowed == asked:
            return None
        self.slip += math.dist(allowed, asked)
        return allowed

    def clip(self, position: Vector) -> Vector:
        """The nearest position that a target may have, world frame [m]."""
        if not self._bounds:
            return position
        x, y, z = (min(max(at, least), greatest) for (least, greatest), at in zip(self._bounds, position, strict=True))
        return x, y, z
