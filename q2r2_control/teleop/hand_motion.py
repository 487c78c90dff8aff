"""Turn the usable poses of one hand into target poses for the tool that the hand moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import pinocchio as pin

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason
from q2r2_control.quaternions import floats_of
from q2r2_control.teleop.carry import CarriedTools, CarriedWorkspace
from q2r2_control.teleop.filters import PoseFilter, RestingPose
from q2r2_control.teleop.leash import Leash, Workspace
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import Array, Pose, moved_by

# Factors of the position scale and the rotation scale: normally 1, less for precise motion, 0 if the hand locks it.
Shares = tuple[float, float]


class HandMotion:
    """Maps the motion of one hand to a tool, or to the frame between two tools that carry one object.

    After :meth:`anchor` the tool never follows earlier motion of the hand, because this motion is not stored.
    """

    def __init__(self, arm: str, settings: TeleopSettings) -> None:
        self._arm = arm
        self.configure(settings)

    def configure(self, settings: TeleopSettings) -> None:
        """Use other settings from now on. The next target needs a new :meth:`anchor`."""
        self._settings = settings
        self._filter = PoseFilter(settings.filter)
        self._rest = RestingPose()
        self._motion, self._unslipped = RelativeMotion.of(settings), RelativeMotion.of(settings)
        self._shares: Shares = (1.0, 1.0)
        self.filtered: Pose | None = None  # The filtered pose of the hand from which the last target was computed.
        # Two poses: the newest pose of the hand, not filtered; and the target that would follow from this hand pose if
        # neither leash nor workspace had held the target back since the anchor.
        self._newest: tuple[Pose, Pose] | None = None
        self._bound_one_tool()

    def _bound_one_tool(self) -> None:
        """Move only this arm's tool from now on, and no longer two tools. The slip begins at 0."""
        self._carried: CarriedTools | None = None
        self._leash = Leash(self._settings.leash)
        self._workspace: Workspace | CarriedWorkspace = self.workspace()

    def workspace(self) -> Workspace:
        return Workspace(self._settings.workspace.get(self._arm))  # type: ignore[call-overload]

    @property
    def slip(self) -> tuple[float, float]:
        """Distance [m] and angle [rad] by which leash and workspace have held the target back since the anchor."""
        return self._leash.position.slip + self._workspace.slip, self._leash.rotation.slip

    def forget(self) -> None:
        self._rest.forget()

    def add(self, hand: Pose, stamp: float, now: float, engaged: bool) -> None:
        """Take a usable pose of the hand.

        Args:
            hand: The pose in the input's frame.
            stamp: The time of receipt [s].
            now: The time [s].
            engaged: Whether the arm is engaged, so that it follows the pose.
        """
        self._rest.add(hand)
        if engaged:
            self._filter.add(hand, stamp, now)

    def anchor(self, hand: Pose, tool: Pose, shares: Shares, now: float) -> None:
        """Let ``hand``, the hand's newest pose (input's frame), correspond to ``tool`` (world frame) from now on."""
        if self._carried is not None:
            self._bound_one_tool()
        hand = self._rest.begin(hand, now)
        self._filter.reset(hand, now)
        self._rescale(hand, tool, shares)
        self._leash.reset()
        self._workspace.reset()

    def carry(self, tools: CarriedTools, other: str, box: Workspace, now: float) -> None:
        """Move the frame of ``tools`` from now on, until the next anchor.

        Args:
            tools: Both tools and the frame between them, which the hand moves.
            other: The name of the other arm.
            box: The workspace of the other arm.
            now: The time [s].
        """
        self._carried = tools
        self._leash = Leash(self._settings.leash.carried())
        self._workspace = CarriedWorkspace(tools, {self._arm: self.workspace(), other: box})
        self._rescale(self._hand(now), floats_of(tools.frame), self._shares)

    def target(self, newest: Pose | None, expected: Pose | None, shares: Shares, now: float) -> Pose:
        """Return the target pose of the tool, or of the frame between two tools, in the world frame.

        Args:
            newest: The newest pose of the hand, not filtered; None if there is none. There is then no leash.
            expected: The pose of the tool, or of the frame, at the controller's reference (world frame). The leash
                keeps the target near this pose. None if the pose is not known. There is then no leash.
            shares: The present factors of the scales.
            now: The time [s].
        """
        hand = self.filtered = self._hand(now)
        if expected is None or newest is None:
            target = self._motion.target_floats(hand)
        else:
            if self._newest is None or self._newest[0] is not newest:
                self._newest = newest, self._unslipped.target_floats(newest)
            target = self._leash.target(self._motion, hand, self._newest[1], expected, now)
        if (held := self._workspace.hold(target)) is not None:
            target = held, target[1]
            self._motion.anchor_position(hand[0], held)
        if self._shares != shares:
            self._rescale(hand, target, shares)  # The new scale counts from here on, so that the target does not jump.
            self._leash.anchor_anew()
        return target

    def _hand(self, now: float) -> Pose:
        return self._rest.draw(self._filter.at(now), now)

    def _rescale(self, hand: Pose, tool: Pose, shares: Shares) -> None:
        """Anchor the hand and the tool at these poses, and use other factors of the scales from now on."""
        self._shares, self._newest = shares, None
        self._motion.rescale(*shares, hand, tool)
        self._unslipped.rescale(*shares, hand, tool)


MAX_OFFSET = 0.05, 0.1  # Greatest plausible difference of a measured and a commanded tool pose [m], [rad].


class Anchor(NamedTuple):
    """The tool pose (world frame) at which an arm is engaged."""

    tool: pin.SE3  # The measured position with the commanded orientation.
    offset: Array | None = None  # Measured position minus commanded position (3,) [m]; None if not known.


@dataclass(slots=True)
class ArmMeasurements:
    """The tool poses of all arms in one tick, by arm. All poses are in the world frame."""

    tools: Mapping[str, pin.SE3]  # The measured tool poses.
    targets: Mapping[str, pin.SE3]  # The target poses of the last tick.
    commanded: Mapping[str, pin.SE3] | None = None  # The tool poses at the controller's reference.
    obstacles: Mapping[str, Reason] = field(default_factory=dict)  # For each arm that may not be engaged, the reason.
    in_step: bool = True  # Whether all poses in ``commanded`` belong to one moment.

    def anchor(self, arm: str) -> Anchor | None:
        """Return the pose at which ``arm`` may be engaged; None if its tool pose is not measured.

        The orientation is the commanded orientation. If no commands are known, it is the orientation of the last
        target. If there is no last target either, it is the measured orientation.
        """
        measured = self.tools.get(arm)
        if measured is None:
            return None
        reference = (self.commanded or self.targets).get(arm, measured)
        tool, commanded = pin.SE3(reference.rotation, measured.translation), (self.commanded or {}).get(arm)
        offset = None if commanded is None else measured.translation - commanded.translation
        return Anchor(tool, offset if offset is not None and math.hypot(*offset) <= MAX_OFFSET[0] else None)

    def last_target(self, arm: str) -> Anchor | None:
        """Return the last target as an anchor, for a hand that takes over from a policy; None if there is no target."""
        return Anchor(self.targets[arm]) if arm in self.targets else None

    def expected(self, arm: str, offset: Array | None) -> Pose | None:
        """Return the tool pose that should be measured after the command (world frame); None if not known.

        ``offset`` is the measured position minus the commanded position (3,) [m]; None if it is not known.
        """
        if self.commanded is None or (commanded := self.commanded.get(arm)) is None:
            return None
        (x, y, z), rotation = pose = floats_of(commanded)
        if offset is None:
            return pose
        by_x, by_y, by_z = offset.tolist()
        return (x + by_x, y + by_y, z + by_z), rotation

    def lag(self, arm: str, offset: Array | None) -> float:
        """Return the distance from the expected tool position to the last target [m]; 0 if one of the two is not known.

        See :meth:`expected`.
        """
        pose, target = self.expected(arm, offset), self.targets.get(arm)
        return 0.0 if pose is None or target is None else math.dist(pose[0], target.translation)


def with_offset(commanded: pin.SE3, offset: Array | None) -> pin.SE3:
    """Return the tool pose that should be measured if ``commanded`` is commanded.

    Both poses are in the world frame. See :class:`Anchor` for ``offset``.
    """
    return commanded if offset is None else moved_by(commanded, offset)
