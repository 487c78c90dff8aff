"""Teleoperation of all arms: from hand samples to tool targets, once per control tick."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import pinocchio as pin

from q2r2_control.config.teleop import Stance, TeleopSettings
from q2r2_control.teleop.arm import ArmState, ArmTeleop
from q2r2_control.types import ArmTarget, Event, HandSample


class Teleop:
    """Hands drive arms relative to anchors; faults stop them.

    An arm starts paused. Its hand's lower button engages and pauses it, the upper toggles its gripper, both together
    are the headset's alignment chord: with ``linked`` it stops both arms, since the frame of both hands may change.

    An engaged arm is paused by: no pose or no button data for ``gate.timeout`` of receipt time, a pose that is not
    finite or not a rotation, a jump past the gate, a lost connection, a loop that stalled or a clock that went back by
    more than ``gate.timeout``; with ``linked`` the other arm too. Only a new press engages again.

    No input makes :meth:`update` raise: samples of unknown hands, old, doubled or in bursts, and any ``now``.
    """

    def __init__(self, settings: TeleopSettings, arms: Sequence[str]) -> None:
        self._linked = settings.linked
        self._stall = settings.gate.timeout
        swapped = settings.stance is not Stance.SIDE_BY_SIDE
        self._arms = {arm: ArmTeleop(arm, settings) for arm in arms}
        self._arm_of_hand = {_other(arm) if swapped else arm: arm for arm in arms}
        self._commanded: dict[str, pin.SE3] = {}
        self._now: float | None = None
        self.delay = settings.filter.interpolation_delay + settings.filter.smoothing_delay

    @property
    def states(self) -> dict[str, ArmState]:
        """State of every arm."""
        return {name: arm.state for name, arm in self._arms.items()}

    @property
    def engaged(self) -> dict[str, bool]:
        """Whether each arm follows its hand now."""
        return {name: arm.state is ArmState.ENGAGED for name, arm in self._arms.items()}

    def hand_of(self, arm: str) -> str:
        """The hand that drives ``arm``."""
        return next(hand for hand, name in self._arm_of_hand.items() if name == arm)

    def take_events(self) -> list[Event]:
        """State changes and refused presses since the last call, in order of time."""
        # At most ticks there is none.
        for arm in self._arms.values():
            if arm.events:
                return self._sorted_events()
        return []

    def _sorted_events(self) -> list[Event]:
        events = sorted((event for arm in self._arms.values() for event in arm.events), key=lambda event: event.t)
        for arm in self._arms.values():
            arm.events.clear()
        return events

    def update(
        self,
        samples: Sequence[HandSample],
        tools: Mapping[str, pin.SE3],
        now: float,
        commanded: Mapping[str, pin.SE3] | None = None,
        obstacles: Mapping[str, str] | None = None,
    ) -> dict[str, ArmTarget]:
        """One tick: process the samples and compute every arm's target.

        ``tools``: measured tool poses in the world frame. ``commanded``: tool poses of the controller's reference; when
        engaging, the position anchors to the measured tool and the orientation to the commanded one, so that sag
        does not add up over many pauses. Without ``commanded`` it is the last target's, at first the measured one.
        ``commanded`` is also what the leash is tied to; without it there is none.
        ``obstacles``: why an arm may not be engaged now, for reasons outside of this layer.
        ``now`` [s] is the clock of the samples' stamps.
        """
        clock_fault = self._clock(now)
        now = self._now if self._now is not None else 0.0
        faults: dict[str, str | None] = {}
        for sample in samples:
            name = self._arm_of_hand.get(sample.hand)
            if name is not None:
                faults[name] = self._arms[name].receive(sample, now) or faults.get(name)
        for name, arm in self._arms.items():
            faults[name] = faults.get(name) or arm.watchdog(now) or clock_fault
        self._disengage(faults, now)
        chord = any(arm.chord for arm in self._arms.values())
        targets = {}
        for name, arm in self._arms.items():
            arm.act(
                partial(self._tool, name, tools, commanded),
                now,
                chord if self._linked else arm.chord,
                None if obstacles is None else obstacles.get(name),
            )
            pose = arm.target(now, None if commanded is None else commanded.get(name))
            if pose is not None:
                self._commanded[name] = pose
            targets[name] = ArmTarget(pose, arm.gripper, *arm.slip)
        return targets

    def connection_lost(self, now: float) -> None:
        """The input is lost: every arm pauses, and everything received is forgotten."""
        self._clock(now)
        for arm in self._arms.values():
            arm.disengage(self._now if self._now is not None else 0.0, "connection lost")
            arm.forget()

    def pause(self, now: float, reason: str) -> None:
        """Every arm holds until a new press, for a reason outside of this layer."""
        self._clock(now)
        for arm in self._arms.values():
            arm.disengage(self._now if self._now is not None else 0.0, reason)

    def _clock(self, now: float) -> str | None:
        """Advance the time; returns the fault of a clock that cannot be followed, or None."""
        last = self._now
        if not math.isfinite(now):
            return "the clock is not finite"
        if last is not None and last - self._stall <= now <= last:
            return None
        self._now = now
        if last is None or 0.0 < now - last <= self._stall:
            return None
        if now > last:
            return f"the control loop stalled for {now - last:.3f} s"
        for arm in self._arms.values():
            arm.forget()
        return f"the clock went back by {last - now:.3f} s"

    def _disengage(self, faults: Mapping[str, str | None], now: float) -> None:
        """Pause the arms whose hand has a fault; that of a hand whose arm is already paused has no effect."""
        active = {name: fault for name, fault in faults.items() if fault and self._is_active(name)}
        for name, fault in active.items():
            self._arms[name].disengage(now, fault)
        if active and self._linked:
            first, fault = next(iter(active.items()))
            for name, arm in self._arms.items():
                if name not in active:
                    arm.disengage(now, f"linked to {first}: {fault}")

    def _is_active(self, name: str) -> bool:
        return self._arms[name].state is not ArmState.PAUSED

    def _tool(self, name: str, tools: Mapping[str, pin.SE3], commanded: Mapping[str, pin.SE3] | None) -> pin.SE3 | None:
        """The tool's pose for an anchor: measured position, commanded orientation."""
        measured = tools.get(name)
        if measured is None:
            return None
        reference = (commanded or self._commanded).get(name, measured)
        return pin.SE3(reference.rotation, measured.translation)


def _other(side: str) -> str:
    return "right" if side == "left" else "left"
