"""Teleoperation of all arms: from hand samples to tool targets, once per control tick."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pinocchio as pin

from q2r2_control.config.bindings import Action
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.quaternions import se3_of
from q2r2_control.teleop.arm import of_controls
from q2r2_control.teleop.arm_states import AT_REST, FOLLOWING, HOLDING, ArmState, Cause
from q2r2_control.teleop.both_arms import BothArms
from q2r2_control.teleop.hand_motion import ArmMeasurements
from q2r2_control.teleop.policy_side import PolicySide
from q2r2_control.types import ActionChunk, ArmTarget, HandSample

_BY_HANDS = ArmState.ENGAGED, ArmState.CARRIED
_LED = FOLLOWING - {ArmState.CARRIED, ArmState.POLICY}  # by their own hand, which moves no other arm


class Teleop:
    """Hands drive arms relative to anchors; faults stop them. The table of transitions is that of :mod:`arm_states`.

    Faults of the data stop an engaged arm: no pose or no button data for ``gate.timeout`` of receipt time, a pose that
    is not finite or not a rotation, a jump or a speed past the gate. Faults around it do so too: one that the input
    found, a lost connection, a stalled loop, or a clock that went back by more than ``gate.timeout``. With ``linked``
    they stop the other arm too. Only a new press engages again. The alignment chord of either hand stops both arms,
    since it moves the frame of both hands.

    Of presses at once, a stop comes first, then the alignment chord, then a pause, then the rest. Either hand may ask
    for actions of both arms. The way home is the caller's to go while :attr:`homing`.

    No input makes :meth:`update` raise: samples of unknown hands, old, doubled or in bursts, and any ``now``.
    """

    def __init__(self, settings: TeleopSettings, arms: Sequence[str]) -> None:
        self._pair = BothArms(settings, arms)
        self._arms = self._pair.arms
        self._policy = PolicySide(self._arms, settings)
        self.marks = self._pair.marks  # the operator's, of the recording
        self._commanded: dict[str, pin.SE3] = {}
        self._now: float | None = None
        self._use(settings)

    def _use(self, settings: TeleopSettings) -> None:
        self.settings, self.delay = settings, settings.filter.delay
        self._linked, self._stall = settings.linked, settings.gate.timeout

    def change(self, settings: TeleopSettings, now: float) -> Reason | None:
        """Other settings from now on, without a jump; returns why that is not possible now, or None.

        Which hand drives an arm, which way its axes go and what its controls mean may change only while the arms hold.
        """
        before = self.settings
        turned = (before.stance, before.axes) != (settings.stance, settings.axes)
        if self._pair.carry is not None:
            return Reason(ReasonKind.CARRYING)
        if (turned or of_controls(before) != of_controls(settings)) and not self._pair.all_in(HOLDING):
            return Reason(ReasonKind.ARMS_MUST_HOLD)
        self._use(settings)
        self._pair.use(settings)
        self._policy.configure(settings)
        for name, arm in self._arms.items():
            arm.configure(settings, self._commanded.get(name), now)
            if turned:
                arm.forget()
        if before.stance is not settings.stance:
            self._pair.assign_hands(settings.stance)
        return None

    @property
    def states(self) -> dict[str, ArmState]:
        return {name: arm.state for name, arm in self._arms.items()}

    @property
    def engaged(self) -> dict[str, bool]:
        """Whether each arm follows a hand or a policy now."""
        return {name: arm.state in (*_BY_HANDS, ArmState.POLICY) for name, arm in self._arms.items()}

    @property
    def interventions(self) -> dict[str, bool]:
        """Whether a hand moves each arm in the place of a policy, which has sent actions before."""
        return {name: self._policy.seen and arm.state in _BY_HANDS for name, arm in self._arms.items()}

    @property
    def aligning(self) -> bool:
        """Whether a hand holds the alignment chord."""
        return any(arm.chord for arm in self._arms.values())

    @property
    def homing(self) -> bool:
        """Whether both arms are to be brought home."""
        return self._pair.any_in(ArmState.HOMING)

    def hand_of(self, arm: str) -> str:
        """The hand that drives ``arm``."""
        return next(hand for hand, driven in self._pair.arm_of_hand.items() if driven == arm)

    def take_events(self) -> list[Event]:
        """State changes and refused presses since the last call, in order of time."""
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
        obstacles: Mapping[str, Reason] | None = None,
        in_step: bool = True,
        chunks: Sequence[ActionChunk] = (),
    ) -> dict[str, ArmTarget]:
        """One tick: process the samples, and a policy's ``chunks``, and compute every arm's target.

        ``tools``: measured tool poses in the world frame. ``commanded``: those of the controller's reference, which the
        leash is tied to; without it there is no leash. ``obstacles``: reasons outside of this layer against engaging an
        arm now. ``in_step``: ``commanded`` has all tools at one moment, so that it may correct the relation of tools
        that carry. ``now`` [s] is the clock of the samples' stamps.
        """
        now, clock_fault = self._clock(now)
        faults: dict[str, Reason] = {}
        for sample in samples:
            name = self._pair.arm_of_hand.get(sample.hand)
            if name is not None and (fault := self._arms[name].receive(sample, now)):
                faults[name] = fault
        for name, arm in self._arms.items():
            if name not in faults and (fault := arm.watchdog(now) or clock_fault):
                faults[name] = fault
        if faults:
            self._disengage(faults, now)
        around = ArmMeasurements(tools, self._commanded, commanded, obstacles or {}, in_step)
        presses = self._pair.act(around, now)
        chord = self.aligning
        for name, arm in self._arms.items():
            arm.act(presses[name], around, now, chord)
        self._policy.update(chunks, around, now, clock_fault)
        return self._targets(now, around)

    def _targets(self, now: float, around: ArmMeasurements) -> dict[str, ArmTarget]:
        carry, carried = self._pair.carry, {}
        if carry is not None and not carry.lasts:
            self._pair.end_carry(now, Reason(ReasonKind.CARRY_ENDED))
            carry = None
        if carry is not None:
            poses = {name: around.expected(name, arm.offset) for name, arm in self._arms.items()}
            expected = {name: se3_of(pose) for name, pose in poses.items() if pose is not None}
            self._commanded |= (carried := carry.targets(now, expected, expected if around.in_step else {}))
        targets = {}
        for name, arm in self._arms.items():
            pose = hand = posture = None
            if carry is not None:
                pose = carried[name]
            elif arm.state is ArmState.ENGAGED:
                self._commanded[name] = pose = se3_of(arm.target(now, around.expected(name, arm.offset)))
            elif arm.state is ArmState.POLICY:
                self._commanded[name] = pose = self._policy.target(name, around, now)
                posture = self._policy.posture(name, now)
            if arm.state is ArmState.ENGAGED:
                hand = arm.motion.filtered
            slip, slip_angle = (arm if carry is None else carry.leader).motion.slip
            targets[name] = ArmTarget(pose, arm.gripper, slip, slip_angle, arm.offset, hand, posture)
        return targets

    def home(self, now: float) -> None:
        """Both arms shall go home, because a program says so. An obstacle is told as an event."""
        self._pair.home(now, None)

    def end_homing(self, now: float, outcome: Reason) -> None:
        """The way home is over, with this ``outcome``: at home, without a way there, or by a fault."""
        fault = outcome.kind in (ReasonKind.HOMING_FAULT, ReasonKind.NOT_HOMING)
        self._pair.change(Cause.FAULT if fault else Cause.HOMED, now, outcome)

    def record_event(self, now: float, reason: Reason) -> None:
        """The things that the operator should know of both arms."""
        for arm in self._arms.values():
            arm.record_event(now, reason)

    def mark(self, now: float, action: Action) -> None:
        """A program marks the recording, as a hand may; see :class:`EpisodeMarks`."""
        next(iter(self._arms.values())).record_event(now, Reason(self.marks.apply(action)))

    def reset(self, now: float, arm: str, reason: Reason) -> None:
        """An arm holds, its hand has to be seen anew before it drives the arm, and a stop of all arms is over."""
        self.hold(now, reason, arm)
        self._arms[arm].forget()
        self._pair.change(Cause.GO_ON, now, reason)

    def hold(self, now: float, reason: Reason, arm: str) -> None:
        """An arm holds because a program asks for it, which is an event also where it holds already."""
        if self._arms[arm].state in AT_REST:
            self._arms[arm].record_event(now, reason)
        self.pause(now, reason, arm)

    def connection_lost(self, now: float) -> None:
        """The input is lost: every arm that a hand drives stops, and everything received is forgotten."""
        now, _ = self._clock(now)
        if not self.homing or self._pair.asks_home is not None:
            self._pair.change(Cause.FAULT, now, Reason(ReasonKind.CONNECTION_LOST))
        for arm in self._arms.values():
            arm.forget()

    def pause(self, now: float, reason: Reason, arm: str | None = None) -> None:
        """Every arm holds until a new press, for a reason outside of this layer.

        With ``arm`` the reason is of that arm: others that follow their hands hold too where they are linked.
        """
        now, _ = self._clock(now)
        if arm is None or self.homing:
            self._pair.change(Cause.FAULT, now, reason)
        elif self._arms[arm].state not in HOLDING:
            self._stop({arm: reason}, now)

    def press_to_engage(self, arm: str | None = None) -> None:
        """As if the hand of an arm, or both, had pressed what engages it; where a dead man does, nothing happens."""
        for name in self._arms if arm is None else (arm,):
            self._arms[name].press_to_engage()

    def give_back(self, now: float) -> None:
        """No hand drives an arm or is waited for: the policy may go on, until a hand is heard of again."""
        now, _ = self._clock(now)
        reason = Reason(ReasonKind.POLICY_REQUESTED)
        self._pair.end_carry(now, reason)
        self._pair.change(Cause.GIVE_BACK, now, reason)
        for arm in self._arms.values():
            arm.heard_of = False

    def _clock(self, now: float) -> tuple[float, Reason | None]:
        """The time from now on, which does not go back a little, and the fault of a clock that cannot be followed."""
        last = self._now
        if not math.isfinite(now):
            return last or 0.0, Reason(ReasonKind.CLOCK_NOT_FINITE)
        if last is not None and last - self._stall <= now <= last:
            return last, None
        self._now = now
        if last is None or 0.0 < now - last <= self._stall:
            return now, None
        if now > last:
            return now, Reason.of(ReasonKind.LOOP_STALLED, duration=now - last)
        for arm in self._arms.values():
            arm.forget()
        return now, Reason.of(ReasonKind.CLOCK_WENT_BACK, duration=last - now)

    def _disengage(self, faults: Mapping[str, Reason], now: float) -> None:
        """Stop the arms whose hand has a fault; that of a hand whose arm holds anyway has no effect."""
        if self.homing:
            if (fault := faults.get(self._pair.asks_home or "")) is not None:
                self._pair.change(Cause.FAULT, now, Reason(ReasonKind.HOMING_FAULT, cause=fault))
            return
        if active := {name: fault for name, fault in faults.items() if self._arms[name].state in _LED}:
            self._stop(active, now)

    def _stop(self, faults: Mapping[str, Reason], now: float) -> None:
        for name, fault in faults.items():
            self._arms[name].change(Cause.FAULT, now, fault)
        first, fault = next(iter(faults.items()))
        for name, arm in self._arms.items():
            if self._linked and name not in faults:
                arm.change(Cause.FAULT, now, Reason.of(ReasonKind.LINKED, cause=fault, arm=first))
