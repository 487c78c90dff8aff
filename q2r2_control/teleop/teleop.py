"""Teleoperation of all arms: from hand samples to tool targets, once per control tick."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import pinocchio as pin

from q2r2_control.config.bindings import Action, Gesture
from q2r2_control.config.teleop import Stance, TeleopSettings
from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.arm_states import AT_REST, FOLLOWING, ArmState, Cause
from q2r2_control.teleop.gestures import Press
from q2r2_control.types import ArmTarget, Event, HandSample


class Teleop:
    """Hands drive arms relative to anchors; faults stop them. What leads where is the table of :mod:`arm_states`.

    An engaged arm is stopped by: no pose or no button data for ``gate.timeout`` of receipt time, a pose that is not
    finite or not a rotation, a jump or a speed past the gate, a fault that the input found, a lost connection, a loop
    that stalled or a clock that went back by more than ``gate.timeout``; with ``linked`` the other arm too. Only a new
    press engages again.

    Of what is pressed at once, a stop comes first, then the alignment chord, then a pause, then the rest. What is
    for both arms either hand may ask for. The way home is the caller's to go while :attr:`homing`.

    No input makes :meth:`update` raise: samples of unknown hands, old, doubled or in bursts, and any ``now``.
    """

    def __init__(self, settings: TeleopSettings, arms: Sequence[str]) -> None:
        self._linked, self._bindings = settings.linked, settings.bindings
        self._stall = settings.gate.timeout
        swapped = settings.stance is not Stance.SIDE_BY_SIDE
        self._arms = {arm: ArmTeleop(arm, settings) for arm in arms}
        self._arm_of_hand = {_other(arm) if swapped else arm: arm for arm in arms}
        self._commanded: dict[str, pin.SE3] = {}
        self._now: float | None = None
        self._asks_home: str | None = None  # the arm whose hand asked for the way home; None: no hand did
        self.delay = settings.filter.interpolation_delay + settings.filter.smoothing_delay

    @property
    def states(self) -> dict[str, ArmState]:
        """State of every arm."""
        return {name: arm.state for name, arm in self._arms.items()}

    @property
    def engaged(self) -> dict[str, bool]:
        """Whether each arm follows its hand now."""
        return {name: arm.state is ArmState.ENGAGED for name, arm in self._arms.items()}

    @property
    def homing(self) -> bool:
        """Whether both arms are to be brought home, until :meth:`end_homing` or what stops them."""
        return any(arm.state is ArmState.HOMING for arm in self._arms.values())

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
        presses = self._act_together(obstacles or {}, now)
        chord = any(arm.chord for arm in self._arms.values())
        targets = {}
        for name, arm in self._arms.items():
            arm.act(
                presses[name],
                partial(self._tool, name, tools, commanded),
                now,
                chord if self._linked else arm.chord,
                None if obstacles is None else obstacles.get(name),
            )
            pose = arm.target(now, None if commanded is None else commanded.get(name))
            if pose is not None:
                self._commanded[name] = pose
            targets[name] = ArmTarget(pose, arm.gripper, *arm.slip)
        if any(presses.values()) and self._asked(presses, Action.SWAP_HANDS) is not None:
            self._swap_hands(now)
        return targets

    def _act_together(self, obstacles: Mapping[str, str], now: float) -> dict[str, list[Press]]:
        """Do what is for both arms; returns the presses that are left for each."""
        presses = {name: arm.take_presses(now) for name, arm in self._arms.items()}
        if not any(presses.values()) and not any(arm.grips or arm.chord for arm in self._arms.values()):
            return presses  # as at most ticks
        states = {arm.state for arm in self._arms.values()}
        if self._asked(presses, Action.STOP) is not None:
            go_on = states == {ArmState.STOPPED}
            self._change(Cause.GO_ON if go_on else Cause.STOP, now, self._reason(Action.STOP))
        elif ArmState.STOPPED in states:
            for name, listed in presses.items():
                if any(press.gesture is not Gesture.DOWN for press in listed):
                    self._arms[name].tell(now, f"not engaged: stopped, {self._bindings.words_of(Action.STOP)} goes on")
        elif ArmState.HOMING in states:
            begun = any(press.gesture is Gesture.DOWN for listed in presses.values() for press in listed)
            if begun or any(arm.grips or arm.chord for arm in self._arms.values()):
                self._change(Cause.PRESS, now, "the way home was interrupted")
        elif (asked_by := self._asked(presses, Action.HOME)) is not None:
            self.home(now, asked_by, obstacles)
        else:
            return presses
        return {name: [] for name in self._arms}

    def home(self, now: float, asked_by: str | None = None, obstacles: Mapping[str, str] | None = None) -> None:
        """Both arms shall go home; the hand of the arm ``asked_by`` has to be there on the way, None: no hand.

        ``obstacles``: see :meth:`update`. What is in the way is told as an event.
        """
        problem = next(iter((obstacles or {}).values()), None)
        if any(arm.state is ArmState.ALIGNING for arm in self._arms.values()):
            problem = problem or "an alignment is not over"
        if any(arm.state is ArmState.STOPPED for arm in self._arms.values()):
            problem = problem or "stopped"
        if problem is None and asked_by is not None:
            problem = self._arms[asked_by].watchdog(now)
        self._asks_home = asked_by
        for arm in self._arms.values():
            if problem is not None:
                arm.tell(now, f"not homing: {problem}")
            else:
                arm.change(Cause.HOME, now, "way home" if asked_by is None else self._reason(Action.HOME))

    @property
    def stopped(self) -> bool:
        """Whether the operator has stopped the arms."""
        return any(arm.state is ArmState.STOPPED for arm in self._arms.values())

    def set_stopped(self, stopped: bool, now: float, reason: str) -> None:
        """Stop all arms, or take that back, because their operator did so elsewhere."""
        self._change(Cause.STOP if stopped else Cause.GO_ON, now, reason)

    def end_homing(self, now: float, outcome: str, arrived: bool = True) -> None:
        """The way home is over, with this ``outcome``; not ``arrived``: because of a fault."""
        self._change(Cause.HOMED if arrived else Cause.FAULT, now, outcome)

    def _swap_hands(self, now: float) -> None:
        """Each hand drives the other arm, and has to be seen anew before it does."""
        alone = len(self._arms) < 2 and "not swapped: this program drives one arm only"
        busy = any(arm.state not in AT_REST for arm in self._arms.values()) and "not swapped: pause both arms first"
        if problem := alone or busy:
            for arm in self._arms.values():
                arm.tell(now, problem)
            return
        self._arm_of_hand = {_other(hand): name for hand, name in self._arm_of_hand.items()}
        for arm in self._arms.values():
            arm.forget()
            arm.tell(now, f"driven by the {self.hand_of(arm.arm)} hand")

    def _asked(self, presses: Mapping[str, Sequence[Press]], action: Action) -> str | None:
        """The arm whose hand asked for ``action``, or None."""
        for name, listed in presses.items():
            if any(self._bindings.action_of(*press) is action for press in listed):
                return name
        return None

    def _reason(self, action: Action) -> str:
        return f"{action} ({self._bindings.words_of(action)})"

    def _change(self, cause: Cause, now: float, reason: str) -> None:
        for arm in self._arms.values():
            arm.change(cause, now, reason)

    def connection_lost(self, now: float) -> None:
        """The input is lost: every arm that a hand drives stops, and everything received is forgotten."""
        self._clock(now)
        if not self.homing or self._asks_home is not None:
            self._change(Cause.FAULT, self._now if self._now is not None else 0.0, "connection lost")
        for arm in self._arms.values():
            arm.forget()

    def pause(self, now: float, reason: str) -> None:
        """Every arm holds until a new press, for a reason outside of this layer."""
        self._clock(now)
        self._change(Cause.FAULT, self._now if self._now is not None else 0.0, reason)

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
        """Stop the arms whose hand has a fault; that of a hand whose arm holds anyway has no effect."""
        if self.homing:
            fault = faults.get(self._asks_home) if self._asks_home is not None else None
            if fault:
                self._change(Cause.FAULT, now, f"on the way home: {fault}")
            return
        active = {name: fault for name, fault in faults.items() if fault and self._arms[name].state in FOLLOWING}
        for name, fault in active.items():
            self._arms[name].change(Cause.FAULT, now, fault)
        if active and self._linked:
            first, fault = next(iter(active.items()))
            for name, arm in self._arms.items():
                if name not in active:
                    arm.change(Cause.FAULT, now, f"linked to {first}: {fault}")

    def _tool(self, name: str, tools: Mapping[str, pin.SE3], commanded: Mapping[str, pin.SE3] | None) -> pin.SE3 | None:
        """The tool's pose for an anchor: measured position, commanded orientation."""
        measured = tools.get(name)
        if measured is None:
            return None
        reference = (commanded or self._commanded).get(name, measured)
        return pin.SE3(reference.rotation, measured.translation)


def _other(side: str) -> str:
    return "right" if side == "left" else "left"
