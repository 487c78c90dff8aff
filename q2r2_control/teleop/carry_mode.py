"""Both arms led by one hand, as long as that arm is engaged and the other one is carried along."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import pinocchio as pin

from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.arm_states import ArmState, Cause
from q2r2_control.teleop.carry import GAIN, REMOTE_GAIN, CarriedTools, RelationKeeper
from q2r2_control.teleop.remote_arm import RemoteArm

CARRIES = "carries both tools"  # what the arm that leads is told
_Poses = Mapping[str, pin.SE3]


class Carrying(Protocol):
    """What a program does of it, for the arms that it drives. Begins when it is made."""

    @property
    def lasts(self) -> bool:
        """Whether nothing has ended it here."""

    @property
    def slip(self) -> tuple[float, float]:
        """Of the targets, see :attr:`HandMotion.slip`."""

    def end(self, now: float, reason: str) -> None:
        """Whichever arm still follows holds."""

    def targets(self, now: float, expected: _Poses, at_once: _Poses) -> dict[str, pin.SE3]:
        """In the world; ``expected``: where tools are to be by the controller's reference, world frame.

        ``at_once``: where that had both at one moment, which may be past; empty: none that is new.
        """


class CarryMode:
    """One hand moves both tools. What ends it ends it for both arms, or the one would pull at what both hold."""

    def __init__(self, leader: ArmTeleop, follower: ArmTeleop | RemoteArm, tools: _Poses, now: float) -> None:
        """``tools``: where both arms' tools are, or are asked to be; world frame."""
        self._leader, self._follower = leader, follower
        self._tools = CarriedTools(tools)
        self._keeper = RelationKeeper(REMOTE_GAIN if isinstance(follower, RemoteArm) else GAIN)
        self._box = follower.workspace()
        follower.change(Cause.CARRY, now, carried_by(leader.arm))
        leader.lead(self._tools, follower.arm, self._box, now)
        leader.tell(now, CARRIES)

    @property
    def lasts(self) -> bool:
        """See :class:`Carrying`."""
        return self._leader.state is ArmState.ENGAGED and self._follower.state is ArmState.CARRIED

    def end(self, now: float, reason: str) -> None:
        """See :class:`Carrying`."""
        for arm in (self._leader, self._follower):
            arm.change(Cause.CARRY_ENDS, now, reason)

    def targets(self, now: float, expected: _Poses, at_once: _Poses) -> dict[str, pin.SE3]:
        """Of both arms, see :class:`Carrying`."""
        tools, leader, follower = self._tools, self._leader.arm, self._follower.arm
        slowest = tools.slowest(tools.frames_of(expected))
        tools.frame = frame = se3_of(self._leader.target(now, None if slowest is None else floats_of(slowest)))
        targets = tools.at(frame)
        if len(frames := tools.frames_of(at_once)) == len(targets):
            self._keeper.note(frames[leader], frames[follower], now)
        if self._keeper.begun:
            position, rotation = floats_of(tools.tool_at(follower, self._keeper.frame(frame)))
            targets[follower] = se3_of((self._box.clip(position), rotation))
        return targets

    @property
    def slip(self) -> tuple[float, float]:
        """See :class:`Carrying`."""
        return self._leader.slip


class CarriedMode:
    """This program's arm follows targets that another program makes, within this arm's own bounds."""

    def __init__(self, follower: ArmTeleop, leader: RemoteArm, tool: pin.SE3, now: float) -> None:
        """``tool``: where this arm's is, or is asked to be; world frame."""
        self._follower, self._leader = follower, leader
        follower.change(Cause.CARRY, now, carried_by(leader.arm))
        follower.be_led()
        leader.begin(tool, now)

    @property
    def lasts(self) -> bool:
        """See :class:`Carrying`."""
        return self._follower.state is ArmState.CARRIED

    def end(self, now: float, reason: str) -> None:
        """See :class:`Carrying`."""
        self._follower.change(Cause.CARRY_ENDS, now, reason)

    def targets(self, now: float, expected: _Poses, at_once: _Poses) -> dict[str, pin.SE3]:
        """Of this arm, see :class:`Carrying`."""
        arm = self._follower
        if not self.lasts or self._leader.pose is None:
            return {}
        tool = expected.get(arm.arm)
        led = arm.led_target(floats_of(self._leader.pose), None if tool is None else floats_of(tool), now)
        return {arm.arm: se3_of(led)}

    @property
    def slip(self) -> tuple[float, float]:
        """See :class:`Carrying`."""
        return self._follower.slip


def carried_by(leader: str) -> str:
    """Why an arm is carried."""
    return f"carries with the {leader} arm"
