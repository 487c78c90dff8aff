"""Both arms led by one hand, as long as that arm is engaged and the other one is carried along."""

from __future__ import annotations

from collections.abc import Mapping

import pinocchio as pin

from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.arm_states import ArmState, Cause
from q2r2_control.teleop.carry import CarriedTools, RelationKeeper
from q2r2_control.types import pose_of

CARRIES = "carries both tools"  # what the arm that leads is told


class CarryMode:
    """Begins when it is made. What ends it ends it for both arms, or the one would pull at what both hold."""

    def __init__(self, leader: ArmTeleop, follower: ArmTeleop, tools: Mapping[str, pin.SE3], now: float) -> None:
        """``tools``: where both arms' tools are, or are asked to be; world frame."""
        self._leader, self._follower = leader, follower
        self._tools, self._keeper = CarriedTools(tools), RelationKeeper()
        self._box = follower.workspace()
        follower.change(Cause.CARRY, now, f"carries with the {leader.arm} arm")
        leader.lead(self._tools, follower, now)
        leader.tell(now, CARRIES)

    @property
    def lasts(self) -> bool:
        """Whether nothing has ended it."""
        return self._leader.state is ArmState.ENGAGED and self._follower.state is ArmState.CARRIED

    def end(self, now: float, reason: str) -> None:
        """Whichever arm still follows holds."""
        for arm in (self._leader, self._follower):
            arm.change(Cause.CARRY_ENDS, now, reason)

    def targets(self, now: float, commanded: Mapping[str, pin.SE3] | None) -> dict[str, pin.SE3]:
        """Of both arms, in the world; ``commanded``: see :meth:`Teleop.update`."""
        tools, leader, follower = self._tools, self._leader.arm, self._follower.arm
        reached = tools.frames_of(commanded or {})
        frame = self._leader.target(now, tools.slowest(reached))
        if frame is None:
            return {}
        tools.frame = frame
        targets = tools.at(frame)
        if len(reached) == len(targets):
            kept = tools.tool_at(follower, self._keeper.frame(frame, reached[leader], reached[follower], now))
            targets[follower] = pose_of(kept.rotation, self._box.clip(kept.translation))
        return targets

    @property
    def slip(self) -> tuple[float, float]:
        """Of both targets, see :attr:`HandMotion.slip`."""
        return self._leader.slip
