"""Teleoperate all arms: turn the samples of the hands into the target tool poses, once per control tick."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pinocchio as pin

from q2r2_control.config.bindings import Action
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import CommonReason, Event, Reason
from q2r2_control.quaternions import se3_of
from q2r2_control.teleop.arm import of_controls
from q2r2_control.teleop.arm_states import AT_REST, FOLLOWING, HOLDING, ArmState, Cause
from q2r2_control.teleop.both_arms import BothArms
from q2r2_control.teleop.crossed_hands import CROSSED, CrossedHands
from q2r2_control.teleop.hand_motion import ArmMeasurements
from q2r2_control.teleop.policy_side import PolicySide
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActionChunk, ArmTarget, HandSample

_BY_HANDS = ArmState.ENGAGED, ArmState.CARRIED
# States in which a fault of an arm's own hand stops the arm.
_HAND_FAULT_STOPS = FOLLOWING - {ArmState.CARRIED, ArmState.POLICY}


class Teleop:
    """Lets hands drive arms relative to anchors, and stops the arms at faults. :mod:`arm_states` has the transitions.

    An engaged arm stops if, for ``gate.timeout``, no pose or no reading of the buttons has been received. It stops if a
    pose is not finite or its quaternion is no rotation, and if the hand jumps or is faster than the gate allows. It
    also stops if the input reports a fault, if the connection is lost, if the loop stalls, or if the clock goes back by
    more than ``gate.timeout``. With ``linked`` the other arm stops as well. Only a new press engages an arm again. The
    alignment chord of either hand stops both arms, because it moves the frame in which the poses of both hands are
    measured.

    If several presses come in the same tick, a stop is carried out first, then the alignment chord, then a pause, then
    the others. Either hand may ask for the actions that concern both arms. While :attr:`homing` is True, the caller
    moves the arms home.

    :meth:`update` never raises because of its input. Samples may be of unknown hands, old, repeated or in bursts, and
    ``now`` may be any number.
    """

    def __init__(self, settings: TeleopSettings, arms: Sequence[str]) -> None:
        self._pair = BothArms(settings, arms)
        self._arms = self._pair.arms
        self._policy = PolicySide(self._arms, settings)
        self.marks = self._pair.marks  # Turns the presses that mark episodes into events.
        self._commanded: dict[str, pin.SE3] = {}
        self._now: float | None = None
        self._use(settings)

    def _use(self, settings: TeleopSettings) -> None:
        self.settings, self.delay = settings, settings.filter.delay
        self._linked, self._stall = settings.linked, settings.gate.timeout
        self._crossed = CrossedHands(settings.axes)

    def change(self, settings: TeleopSettings, now: float) -> Reason | None:
        """Use other settings from now on. The targets do not jump.

        The hand that drives an arm, the directions of the axes, and the actions of the controls may change only while
        the arms hold.

        Returns:
            Why the settings cannot change now; None if they have changed.
        """
        before = self.settings
        turned = (before.stance, before.axes) != (settings.stance, settings.axes)
        if self._pair.carry is not None:
            return Reason(TeleopReason.CARRYING)
        if (turned or of_controls(before) != of_controls(settings)) and not self._pair.all_in(HOLDING):
            return Reason(TeleopReason.ARMS_MUST_HOLD)
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
        """For each arm, True if it follows a hand or a policy now."""
        return {name: arm.state in (*_BY_HANDS, ArmState.POLICY) for name, arm in self._arms.items()}

    @property
    def interventions(self) -> dict[str, bool]:
        """For each arm, True if a hand moves it and a policy has sent actions in this run."""
        return {name: self._policy.seen and arm.state in _BY_HANDS for name, arm in self._arms.items()}

    @property
    def aligning(self) -> bool:
        """Whether a hand holds the alignment chord."""
        return any(arm.chord for arm in self._arms.values())

    @property
    def homing(self) -> bool:
        """Whether the caller has to move both arms home."""
        return self._pair.any_in(ArmState.HOMING)

    def hand_of(self, arm: str) -> str:
        """Return the hand that drives ``arm``."""
        return next(hand for hand, driven in self._pair.arm_of_hand.items() if driven == arm)

    def take_events(self) -> list[Event]:
        """Return the changes of state and the refused presses since the previous call, in order of time."""
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
        """Process the samples of one tick and the chunks of a policy, and compute the target of every arm.

        Args:
            samples: The new samples of all hands.
            tools: The measured tool poses, in the world frame.
            now: The time, by the same clock as the samples' stamps [s].
            commanded: The tool poses at the controller's reference, in the world frame. The leash keeps each target
                near this pose. Without these poses there is no leash.
            obstacles: For each arm that may not be engaged now, the reason. The caller has to find these reasons.
            in_step: Whether all poses in ``commanded`` belong to one moment. Only then may they correct the relative
                pose of two tools that carry one object.
            chunks: The new action chunks of a policy.

        Returns:
            The target of every arm.
        """
        now, clock_fault = self._clock(now)
        faults: dict[str, Reason] = {}
        for sample in samples:
            self._crossed.add(sample)
            name = self._pair.arm_of_hand.get(sample.hand)
            if name is not None and (fault := self._arms[name].receive(sample, now)):
                faults[name] = fault
        for name, arm in self._arms.items():
            if name not in faults and (fault := arm.watchdog(now) or clock_fault):
                faults[name] = fault
        if faults:
            self._disengage(faults, now)
        around = ArmMeasurements(tools, self._commanded, commanded, obstacles or {}, in_step)
        engaged = [name for name, arm in self._arms.items() if arm.state is ArmState.ENGAGED]
        presses = self._pair.act(around, now)
        chord = self.aligning
        for name, arm in self._arms.items():
            arm.act(presses[name], around, now, chord)
        new = [arm for name, arm in self._arms.items() if arm.state is ArmState.ENGAGED and name not in engaged]
        if new and self._crossed.crossed(now):
            new[0].record_event(now, CROSSED)
        self._policy.update(chunks, around, now, clock_fault)
        return self._targets(now, around)

    def _targets(self, now: float, around: ArmMeasurements) -> dict[str, ArmTarget]:
        carry, carried = self._pair.carry, {}
        if carry is not None and not carry.lasts:
            self._pair.end_carry(now, Reason(TeleopReason.CARRY_ENDED))
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
        """Let both arms go home because a program asks for it. If they may not, an event says why."""
        self._pair.home(now, None)

    def end_homing(self, now: float, outcome: Reason) -> None:
        """End the motion home. The ``outcome`` says whether the arms have arrived, cannot go on, or had a fault."""
        fault = outcome.kind in (CommonReason.HOMING_FAULT, TeleopReason.NOT_HOMING)
        self._pair.change(Cause.FAULT if fault else Cause.HOMED, now, outcome)

    def record_event(self, now: float, reason: Reason) -> None:
        """Record an event for the operator, once for each arm. No state changes."""
        for arm in self._arms.values():
            arm.record_event(now, reason)

    def mark(self, now: float, action: Action) -> None:
        """Apply an action of :class:`EpisodeMarks` because a program asks for it. A press has the same effect."""
        next(iter(self._arms.values())).record_event(now, self.marks.apply(action))

    def reset(self, now: float, arm: str, reason: Reason) -> None:
        """Let an arm hold, and forget all samples of its hand. If the operator has stopped the arms, end this stop."""
        self.hold(now, reason, arm)
        self._arms[arm].forget()
        self._pair.change(Cause.GO_ON, now, reason)

    def hold(self, now: float, reason: Reason, arm: str) -> None:
        """Let an arm hold because a program asks for it. An event is recorded even if the arm holds already."""
        if self._arms[arm].state in AT_REST:
            self._arms[arm].record_event(now, reason)
        self.pause(now, reason, arm)

    def connection_lost(self, now: float) -> None:
        """Stop the arms, and forget all samples, because the input is lost.

        If arms move home because a program has asked for it, they continue.
        """
        now, _ = self._clock(now)
        if not self.homing or self._pair.asks_home is not None:
            self._pair.change(Cause.FAULT, now, Reason(TeleopReason.CONNECTION_LOST))
        for arm in self._arms.values():
            arm.forget()

    def pause(self, now: float, reason: Reason, arm: str | None = None) -> None:
        """Let every arm hold until a new press, for a ``reason`` that the caller gives.

        If ``arm`` is given, the reason concerns only that arm. The other arm then holds only if the arms are linked.
        """
        now, _ = self._clock(now)
        if arm is None or self.homing:
            self._pair.change(Cause.FAULT, now, reason)
        elif self._arms[arm].state not in HOLDING:
            self._stop({arm: reason}, now)

    def press_to_engage(self, arm: str | None = None) -> None:
        """Act as if the hand of ``arm`` pressed the button that engages; without ``arm``, as if both hands did.

        A dead man's switch cannot be held in this way.
        """
        for name in self._arms if arm is None else (arm,):
            self._arms[name].press_to_engage()

    def give_back(self, now: float) -> None:
        """Let a policy move the arms that hands have driven.

        If a fault stops an arm afterwards, the policy may move it again without a press. After the next reading of the
        arm's hand, a press is needed again.
        """
        now, _ = self._clock(now)
        reason = Reason(TeleopReason.POLICY_REQUESTED)
        self._pair.end_carry(now, reason)
        self._pair.change(Cause.GIVE_BACK, now, reason)
        for arm in self._arms.values():
            arm.heard_of = False

    def _clock(self, now: float) -> tuple[float, Reason | None]:
        """Return the time to use, and a fault or None.

        The time does not go back if the clock goes back by at most the timeout. It is a fault if the clock goes back by
        more, is not finite, or has advanced by more than the timeout since the previous call of this method.
        """
        last = self._now
        if not math.isfinite(now):
            return last or 0.0, Reason(TeleopReason.CLOCK_NOT_FINITE)
        if last is not None and last - self._stall <= now <= last:
            return last, None
        self._now = now
        if last is None or 0.0 < now - last <= self._stall:
            return now, None
        if now > last:
            return now, Reason.of(CommonReason.LOOP_STALLED, duration=now - last)
        for arm in self._arms.values():
            arm.forget()
        return now, Reason.of(TeleopReason.CLOCK_WENT_BACK, duration=last - now)

    def _disengage(self, faults: Mapping[str, Reason], now: float) -> None:
        """Stop the arms whose hands have faults. A fault has no effect on an arm that holds already."""
        if self.homing:
            if (fault := faults.get(self._pair.asks_home or "")) is not None:
                self._pair.change(Cause.FAULT, now, Reason(CommonReason.HOMING_FAULT, cause=fault))
            return
        if active := {name: fault for name, fault in faults.items() if self._arms[name].state in _HAND_FAULT_STOPS}:
            self._stop(active, now)

    def _stop(self, faults: Mapping[str, Reason], now: float) -> None:
        for name, fault in faults.items():
            self._arms[name].change(Cause.FAULT, now, fault)
        first, fault = next(iter(faults.items()))
        for name, arm in self._arms.items():
            if self._linked and name not in faults:
                arm.change(Cause.FAULT, now, Reason.of(TeleopReason.LINKED, cause=fault, arm=first))
