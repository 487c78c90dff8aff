"""The state machine of one arm: its hand, its buttons, and the faults of both."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

import numpy as np
import pinocchio as pin

from q2r2_control.config.bindings import ButtonAction, HeldAction
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.teleop.buttons import ButtonArbiter, Press
from q2r2_control.teleop.filters import PoseFilter
from q2r2_control.teleop.gate import PoseGate
from q2r2_control.teleop.held_controls import HeldControls
from q2r2_control.teleop.leash import Leash
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.teleop.rest import RestingPose
from q2r2_control.types import Event, HandSample

OPEN, CLOSED = 1.0, 0.0
LET_GO = "dead man let go"
BY_OPERATOR = frozenset({"lower button", "upper button", LET_GO})  # reasons of a pause that are no fault


class ArmState(StrEnum):
    """Only an engaged arm follows its hand; in every other state it holds."""

    PAUSED = "paused"
    ENGAGED = "engaged"
    PAUSING = "pausing"  # stopped by a button, which may still turn out to be half a chord
    ALIGNING = "aligning"  # stopped by the alignment chord; anchored when the buttons are released


def is_fault(event: Event) -> bool:
    """Whether an arm was paused, or stays so, for another reason than what its operator pressed."""
    return event.destination == ArmState.PAUSED and event.reason not in BY_OPERATOR


class ArmTeleop:
    """Teleoperation of one arm by one hand.

    Every transition to ENGAGED calls :meth:`_anchor`, which anchors hand and tool at their current poses and starts the
    filter at rest there. So there is no catch-up motion: no state holds what the hand did before.
    """

    def __init__(self, arm: str, settings: TeleopSettings) -> None:
        self.arm = arm
        self.state = ArmState.PAUSED
        self.gripper = OPEN
        self.events: list[Event] = []
        self._bindings, self._precision = settings.bindings, settings.precision_scale
        self._held = HeldControls(settings.bindings)
        self._has_dead_man = settings.bindings.control_of(HeldAction.DEAD_MAN) is not None
        self._shares = 1.0, 1.0  # of the scales of positions and rotations
        self._timeout = settings.gate.timeout
        self._gate = PoseGate(settings.gate)
        self._buttons = ButtonArbiter(settings.chord_window)
        self._filter = PoseFilter(settings.filter)
        self._rest = RestingPose(settings.filter.average_at_rest)
        self._motion, self._unslipped = (
            RelativeMotion(
                settings.stance,
                settings.position_scale,
                settings.rotation_frame,
                settings.rotation_scale,
                settings.axes,
            )
            for _ in range(2)
        )
        self._newest: tuple[pin.SE3, pin.SE3] | None = None  # the newest hand pose and where it would have the tool
        self._leash = Leash(settings.leash)
        self._presses: list[Press] = []
        self._gripped: bool | None = None  # the dead man was just held, or let go
        self._aligned_at = 0.0
        self._obstacle: str | None = None

    @property
    def chord(self) -> bool:
        """Whether this hand's alignment chord is held."""
        return self._buttons.chord

    @property
    def held(self) -> frozenset[HeldAction]:
        """What the hand's triggers and stick are held for."""
        return self._held.actions

    def receive(self, sample: HandSample, now: float) -> str | None:
        """Process one sample of this arm's hand; returns the fault that forbids to follow it any longer, or None."""
        self._presses += self._buttons.receive(sample.inputs, sample.inputs_stamp, now)
        held = self.held
        self._held.receive(sample.inputs, sample.inputs_stamp, now)
        if HeldAction.DEAD_MAN in held ^ self.held:
            self._gripped = HeldAction.DEAD_MAN in self.held
        usable, fault = self._gate.receive(sample, now)
        if usable and fault is None and self._gate.pose is not None:
            self._rest.add(self._gate.pose)
            if self.state is ArmState.ENGAGED:
                self._filter.add(self._gate.pose, self._gate.stamp, now)
        if usable and self.state is ArmState.ALIGNING:
            return None  # realigning makes the pose jump, and the arm is not following
        return fault

    def watchdog(self, now: float) -> str | None:
        """The fault of a stream that has stopped, or None."""
        if self._gate.stale(now):
            return f"no pose for {self._timeout:g} s"
        if self._buttons.stale(now, self._timeout):
            return f"no button data for {self._timeout:g} s"
        return None

    def disengage(self, now: float, reason: str) -> None:
        """Hold until a new press; one that began before does not count."""
        self._buttons.cancel()
        self._presses.clear()
        self._gripped = None
        self._go(ArmState.PAUSED, now, reason)

    def forget(self) -> None:
        """Drop everything received: poses are forgotten, buttons count as held until they are seen released."""
        self._gate.reset()
        self._rest.forget()
        self._buttons.forget()
        self._held.forget()
        self._presses.clear()
        self._gripped = None

    def act(self, tool: Callable[[], pin.SE3 | None], now: float, chord: bool, obstacle: str | None = None) -> None:
        """Change the state by buttons and chords.

        ``tool``: gives the pose to anchor to, None if not known, and is only asked where the arm is engaged;
        ``chord``: whether an alignment chord stops this arm; ``obstacle``: why the arm may not be engaged now, or None.
        """
        self._obstacle = obstacle
        if self._gripped is False and self.state in (ArmState.ENGAGED, ArmState.ALIGNING):
            self._go(ArmState.PAUSED, now, LET_GO)
        if chord:
            self._align(now)
        elif self.state is ArmState.ALIGNING and self._gate.pose is not None and self._gate.stamp >= self._aligned_at:
            self._engage(tool(), now, "aligned anew")
        elif self._gripped and self.state is ArmState.PAUSED:
            self._engage(tool(), now, "dead man held")
        self._gripped = None
        if presses := self._presses + self._buttons.due(now):
            for press in presses:
                self._press(press, tool, now)
            self._presses.clear()

    def target(self, now: float, commanded: pin.SE3 | None = None) -> pin.SE3 | None:
        """Where the tool should be at ``now`` in the world frame; None: hold.

        ``commanded``: the tool's pose at the controller's reference, from which no target is farther than the leash.
        """
        if self.state is not ArmState.ENGAGED:
            return None
        hand = self._rest.draw(self._filter.at(now), now)
        if commanded is None or self._gate.pose is None:
            target = self._motion.target(hand)
        else:
            if self._newest is None or self._newest[0] is not self._gate.pose:
                self._newest = self._gate.pose, self._unslipped.target(self._gate.pose)
            target = self._leash.target(self._motion, hand, self._newest[1], commanded, now)
        if self._shares != self._held_shares():
            self._rescale(hand, target)  # from here on, so the target does not jump
            self._leash.anchor_anew()
        return target

    @property
    def slip(self) -> tuple[float, float]:
        """How far the target has slipped along with the tool since engaging [m, rad]."""
        return self._leash.slip, self._leash.slip_angle

    def _align(self, now: float) -> None:
        self._aligned_at = now
        if self.state is ArmState.ENGAGED or (self.state is ArmState.PAUSING and self.chord):
            self._go(ArmState.ALIGNING, now, "alignment chord")

    def _press(self, press: Press, tool: Callable[[], pin.SE3 | None], now: float) -> None:
        is_upper = press in (Press.UPPER, Press.UPPER_DOWN)
        action = self._bindings.upper if is_upper else self._bindings.lower
        button = "upper button" if is_upper else "lower button"
        if press in (Press.UPPER_DOWN, Press.LOWER_DOWN):
            if action is ButtonAction.PAUSE_TOGGLE and self.state is ArmState.ENGAGED:
                self._go(ArmState.PAUSING, now, button)
        elif action is ButtonAction.GRIPPER_TOGGLE:
            self.gripper = CLOSED if self.gripper == OPEN else OPEN
        elif action is ButtonAction.PAUSE_TOGGLE and self.state is ArmState.PAUSING:
            self._go(ArmState.PAUSED, now, button)
        elif action is ButtonAction.PAUSE_TOGGLE and self.state is ArmState.PAUSED:
            self._engage(tool(), now, button)

    def _engage(self, tool: pin.SE3 | None, now: float, reason: str) -> None:
        obstacle = self._obstacle or self.watchdog(now)
        if self._has_dead_man and HeldAction.DEAD_MAN not in self.held:
            obstacle = obstacle or "the dead man is not held"
        if self._gate.pose is None:
            obstacle = obstacle or "the newest pose is not usable"
        elif tool is None or not np.isfinite(tool.homogeneous).all():
            obstacle = obstacle or "the tool's pose is not known"
        else:
            self._anchor(self._gate.pose, tool, now)
        if obstacle is None:
            self._go(ArmState.ENGAGED, now, reason)
        else:
            self.events.append(Event(now, self.arm, self.state, ArmState.PAUSED, f"not engaged: {obstacle}"))
            self.state = ArmState.PAUSED

    def _anchor(self, hand: pin.SE3, tool: pin.SE3, now: float) -> None:
        hand = self._rest.begin(hand, now)
        self._filter.reset(hand, now)
        self._rescale(hand, tool)
        self._leash.reset()

    def _held_shares(self) -> tuple[float, float]:
        """Of the scales, by what is held."""
        share = self._precision if HeldAction.PRECISION in self.held else 1.0
        return (
            0.0 if HeldAction.TRANSLATION_LOCK in self.held else share,
            0.0 if HeldAction.ROTATION_LOCK in self.held else share,
        )

    def _rescale(self, hand: pin.SE3, tool: pin.SE3) -> None:
        """Anchor hand and tool, with the scales that hold from now on."""
        self._shares, self._newest = self._held_shares(), None
        self._motion.rescale(*self._shares, hand, tool)
        self._unslipped.rescale(*self._shares, hand, tool)

    def _go(self, state: ArmState, now: float, reason: str) -> None:
        if state is not self.state:
            self.events.append(Event(now, self.arm, self.state, state, reason))
            self.state = state
