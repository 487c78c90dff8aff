"""From the usable poses of one hand to targets."""

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

Shares = tuple[float, float]  # of the scales of positions and rotations


class HandMotion:
    """One hand's motion as that of a tool, or of the frame between two tools that carry.

    There is no catch-up motion after :meth:`anchor`, because no state holds the hand's motion before.
    """

    def __init__(self, arm: str, settings: TeleopSettings) -> None:
        self._arm = arm
        self.configure(settings)

    def configure(self, settings: TeleopSettings) -> None:
        """Other settings from now on. Before the next target there has to be an anchor."""
        self._settings = settings
        self._filter = PoseFilter(settings.filter)
        self._rest = RestingPose()
        self._motion, self._unslipped = RelativeMotion.of(settings), RelativeMotion.of(settings)
        self._shares: Shares = (1.0, 1.0)
        self.filtered: Pose | None = None  # the hand's pose that the last target was made of
        # The newest hand pose, and where it would have the tool if nothing had slipped.
        self._newest: tuple[Pose, Pose] | None = None
        self._bound_one_tool()

    def _bound_one_tool(self) -> None:
        """Targets are those of this arm's tool from now on, and nothing has slipped."""
        self._carried: CarriedTools | None = None
        self._leash = Leash(self._settings.leash)
        self._workspace: Workspace | CarriedWorkspace = self.workspace()

    def workspace(self) -> Workspace:
        return Workspace(self._settings.workspace.get(self._arm))  # type: ignore[call-overload]

    @property
    def slip(self) -> tuple[float, float]:
        """How far the target has slipped along since the anchor, with the tool or along its workspace [m, rad]."""
        return self._leash.position.slip + self._workspace.slip, self._leash.rotation.slip

    def forget(self) -> None:
        self._rest.forget()

    def add(self, hand: Pose, stamp: float, now: float, engaged: bool) -> None:
        """A usable pose of the hand, received at ``stamp`` [s]; followed if its arm is ``engaged``, so anchored."""
        self._rest.add(hand)
        if engaged:
            self._filter.add(hand, stamp, now)

    def anchor(self, hand: Pose, tool: Pose, shares: Shares, now: float) -> None:
        """The newest pose of the ``hand`` and ``tool``, in the world, correspond from now on."""
        if self._carried is not None:
            self._bound_one_tool()
        hand = self._rest.begin(hand, now)
        self._filter.reset(hand, now)
        self._rescale(hand, tool, shares)
        self._leash.reset()
        self._workspace.reset()

    def carry(self, tools: CarriedTools, other: str, box: Workspace, now: float) -> None:
        """Move the frame of ``tools`` from now on, until the next anchor; ``box``: that of the ``other`` arm."""
        self._carried = tools
        self._leash = Leash(self._settings.leash.carried())
        self._workspace = CarriedWorkspace(tools, {self._arm: self.workspace(), other: box})
        self._rescale(self._hand(now), floats_of(tools.frame), self._shares)

    def target(self, newest: Pose | None, expected: Pose | None, shares: Shares, now: float) -> Pose:
        """Where the tool, or the frame, should be at ``now`` [s] in the world.

        ``newest``: the hand's newest pose; ``expected``: the tool or the frame by the controller's reference, which no
        target is farther from than the leash. Without either there is no leash.
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
            self._rescale(hand, target, shares)  # from here on, so the target does not jump
            self._leash.anchor_anew()
        return target

    def _hand(self, now: float) -> Pose:
        return self._rest.draw(self._filter.at(now), now)

    def _rescale(self, hand: Pose, tool: Pose, shares: Shares) -> None:
        """Anchor hand and tool, with the scales that hold from now on."""
        self._shares, self._newest = shares, None
        self._motion.rescale(*shares, hand, tool)
        self._unslipped.rescale(*shares, hand, tool)


MAX_OFFSET = 0.05, 0.1  # of a tool from its command [m], [rad]


class Anchor(NamedTuple):
    """Where a tool is when its arm is engaged, world frame."""

    tool: pin.SE3  # measured position, commanded orientation
    offset: Array | None = None  # (3,) [m]; None: none


@dataclass(slots=True)
class ArmMeasurements:
    """State of the arms themselves in one tick; poses are in the world."""

    tools: Mapping[str, pin.SE3]  # measured
    targets: Mapping[str, pin.SE3]  # the last ones
    commanded: Mapping[str, pin.SE3] | None = None  # by the controller's reference
    obstacles: Mapping[str, Reason] = field(default_factory=dict)  # arm -> why it may not be engaged
    in_step: bool = True  # ``commanded`` is of one moment

    def anchor(self, arm: str) -> Anchor | None:
        """The measured position and the commanded orientation, or else that of the last target; None: not known."""
        measured = self.tools.get(arm)
        if measured is None:
            return None
        reference = (self.commanded or self.targets).get(arm, measured)
        tool, commanded = pin.SE3(reference.rotation, measured.translation), (self.commanded or {}).get(arm)
        offset = None if commanded is None else measured.translation - commanded.translation
        return Anchor(tool, offset if offset is not None and math.hypot(*offset) <= MAX_OFFSET[0] else None)

    def last_target(self, arm: str) -> Anchor | None:
        """Where a policy left the target; None: there is none."""
        return Anchor(self.targets[arm]) if arm in self.targets else None

    def expected(self, arm: str, offset: Array | None) -> Pose | None:
        """Where a tool with this offset is to be measured, by what is commanded. None: not known."""
        if self.commanded is None or (commanded := self.commanded.get(arm)) is None:
            return None
        (x, y, z), rotation = pose = floats_of(commanded)
        if offset is None:
            return pose
        by_x, by_y, by_z = offset.tolist()
        return (x + by_x, y + by_y, z + by_z), rotation

    def lag(self, arm: str, offset: Array | None) -> float:
        """From where the controller has a tool to its last target [m]."""
        pose, target = self.expected(arm, offset), self.targets.get(arm)
        return 0.0 if pose is None or target is None else math.dist(pose[0], target.translation)


def with_offset(commanded: pin.SE3, offset: Array | None) -> pin.SE3:
    """Where a tool is to be measured that is commanded to be at ``commanded``."""
    return commanded if offset is None else moved_by(commanded, offset)
