"""Both arms led by one hand, as long as that arm is engaged and the other one is carried along."""

from __future__ import annotations

from collections.abc import Mapping

import pinocchio as pin

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.arm_states import ArmState, Cause
from q2r2_control.teleop.carry import CarriedTools, RelationKeeper

_Poses = Mapping[str, pin.SE3]


class CarryMode:
    """One hand moves both tools. What ends it ends it for both arms, or the one would pull at what both hold."""

    def __init__(self, leader: ArmTeleop, follower: ArmTeleop, tools: _Poses, now: float) -> None:
        """``tools``: where both arms' tools are, or are asked to be; world frame."""
        self._leader, self._follower = leader, follower
        self._tools = CarriedTools(tools)
        self._keeper = RelationKeeper()
        self._box = follower.motion.workspace()
        follower.change(Cause.CARRY, now, Reason.of(ReasonKind.CARRIED_BY, arm=leader.arm))
        leader.motion.carry(self._tools, follower.arm, self._box, now)
        leader.record_event(now, Reason(ReasonKind.CARRY_BEGAN))

    @property
    def lasts(self) -> bool:
        """Whether both arms still carry."""
        return self._leader.state is ArmState.ENGAGED and self._follower.state is ArmState.CARRIED

    def end(self, now: float, reason: Reason) -> None:
        """Whichever arm still follows holds."""
        for arm in (self._leader, self._follower):
            arm.change(Cause.CARRY_ENDS, now, reason)

    def targets(self, now: float, expected: _Poses, at_once: _Poses) -> dict[str, pin.SE3]:
        """Of both arms, in the world frame.

        ``expected``: where the tools are to be by the controller's reference, world frame. ``at_once``: where it had
        both at one moment, which corrects their relation; empty: not known.
        """
        tools, leader, follower = self._tools, self._leader.arm, self._follower.arm
        slowest = tools.slowest(tools.frames_of(expected))
        tools.frame = frame = se3_of(self._leader.target(now, None if slowest is None else floats_of(slowest)))
        targets = tools.at(frame)
        if len(frames := tools.frames_of(at_once)) == len(targets):
            self._keeper.note(frames[leader], frames[follower], now)
        position, rotation = floats_of(tools.tool_at(follower, self._keeper.frame(frame)))
        targets[follower] = se3_of((self._box.clip(position), rotation))
        return targets

    @property
    def slip(self) -> tuple[float, float]:
        """Of the targets, see :attr:`HandMotion.slip`."""
        return self._leader.motion.slip
