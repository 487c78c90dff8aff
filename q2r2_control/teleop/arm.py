"""Teleoperate one arm: its hand, the hand's controls, and the faults of both."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pinocchio as pin

from q2r2_control.config.bindings import BUTTONS, Action, BindingSettings, Gesture
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Event, Reason
from q2r2_control.quaternions import floats_of
from q2r2_control.teleop.arm_states import ArmState, Cause, next_state
from q2r2_control.teleop.gate import PoseGate
from q2r2_control.teleop.gestures import GestureRecognizer, HeldControls, Press, travel
from q2r2_control.teleop.hand_motion import ArmMeasurements, HandMotion, Shares
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import Array, HandInputs, HandSample, Pose

# The next three numbers are shares of a trigger's travel.
_SLACK = 0.05  # The first and the last part of the travel have no effect, since not every trigger reaches its ends.
_HYSTERESIS = 0.02  # If the trigger moves by less than this, the motion counts as tremor and changes nothing.
_PICK_UP = 0.05  # The trigger begins to move the gripper when it is this near to the gripper's opening.


OPEN, CLOSED = 1.0, 0.0


class AnalogGripper:
    """The opening that a trigger asks for, from 0 for closed to 1 for fully open.

    After a new connection, a change of the stance or a stop, the trigger moves nothing until it reaches the opening
    that the gripper has. A gripper that holds an object therefore stays closed although nobody presses the trigger yet.
    """

    def __init__(self, bindings: BindingSettings, speed: float) -> None:
        """``speed`` is the greatest change of the opening per second [1/s]."""
        bound = (binding.control for binding in bindings.bound() if binding.action is Action.GRIPPER_ANALOG)
        self._control = next(bound, None)
        self._speed, self._at = speed, -math.inf
        self.forget()

    def forget(self) -> None:
        """Ignore the trigger until it reaches the opening that the gripper has."""
        self._wanted: float | None = None
        self._picked_up = False

    def receive(self, inputs: HandInputs, opening: float) -> None:
        """Process a new reading while the gripper is commanded to ``opening``."""
        if self._control is None or not math.isfinite(value := travel(self._control, inputs)):
            return
        wanted = 1.0 - min(max((value - _SLACK) / (1.0 - 2.0 * _SLACK), 0.0), 1.0)
        before = wanted if self._wanted is None else self._wanted
        if not self._picked_up:
            self._picked_up = min(before, wanted) - _PICK_UP <= opening <= max(before, wanted) + _PICK_UP
            self._wanted = wanted
        elif abs(wanted - before) >= _HYSTERESIS or wanted in (0.0, 1.0):
            self._wanted = wanted

    def opening(self, opening: float, now: float) -> float:
        """Return the opening to command at ``now`` [s]. ``opening`` is the present command."""
        passed, self._at = now - self._at, now
        if self._wanted is None or not self._picked_up or not math.isfinite(passed):
            return opening
        step = self._speed * max(passed, 0.0)
        return opening + min(max(self._wanted - opening, -step), step)


class ArmTeleop:
    """Moves one arm as its hand asks. When the arm is engaged, hand and tool are anchored; see :class:`HandMotion`."""

    def __init__(self, arm: str, settings: TeleopSettings) -> None:
        self.arm = arm
        self.state = ArmState.IDLE
        self.gripper = OPEN
        # Measured tool position minus commanded tool position, when the arm was last engaged (3,) [m]; None if not
        # known.
        self.offset: Array | None = None
        self.events: list[Event] = []
        self.motion = HandMotion(arm, settings)
        self._settings = settings
        self._gate = PoseGate(settings.gate)
        self._use_controls(settings)
        self._inputs_stamp = -math.inf  # Time of the newest reading of the controls [s].
        # Whether a reading of the hand's controls has come since the start, or since a program gave the arms to a
        # policy.
        self.heard_of = False
        self._presses: list[Press] = []
        # True if the dead man's switch was just pressed, False if it was just released, None otherwise.
        self.gripped: bool | None = None
        self._aligned_at = 0.0

    def _use_controls(self, settings: TeleopSettings) -> None:
        self._held = HeldControls(settings.bindings)
        self._analog = AnalogGripper(settings.bindings, settings.gripper_speed)
        self._gestures = GestureRecognizer(settings)

    def configure(self, settings: TeleopSettings, last: pin.SE3 | None, now: float) -> None:
        """Use other settings from now on. Settings of the hand's controls may change only while the arm holds.

        Args:
            settings: The new settings.
            last: The last target in the world frame. An engaged arm is anchored at it, so that it does not jump.
            now: The time [s].
        """
        if of_controls(settings) != of_controls(self._settings):
            self._use_controls(settings)
        self._settings = settings
        self._gate.settings = settings.gate
        self.motion.configure(settings)
        if self.state is ArmState.ENGAGED and self._gate.pose is not None and last is not None:
            self.motion.anchor(self._gate.pose, floats_of(last), self._shares(), now)

    @property
    def chord(self) -> bool:
        """Whether this hand's alignment chord is held."""
        return self._gestures.chord

    def receive(self, sample: HandSample, now: float) -> Reason | None:
        """Process one sample of this arm's hand; returns the fault for which the arm must stop, or None."""
        stamp = min(sample.inputs_stamp, now)
        if -math.inf < stamp and self._inputs_stamp <= stamp:  # A reading that is older than the last one is ignored.
            self._inputs_stamp, self.heard_of = stamp, True
            self._presses += self._gestures.receive(sample.inputs, stamp)
            before = self._held.actions
            self._held.receive(sample.inputs)
            self._analog.receive(sample.inputs, self.gripper)
            if Action.DEAD_MAN in before ^ self._held.actions:
                self.gripped = Action.DEAD_MAN in self._held.actions
        usable, fault = self._gate.receive(sample, now)
        if usable and fault is None and self._gate.pose is not None:
            self.motion.add(self._gate.pose, self._gate.stamp, now, self.state is ArmState.ENGAGED)
        if usable and self.state is ArmState.ALIGNING:
            # A jump is no fault here, because the alignment makes the pose jump, and the arm does not follow the jump.
            return None
        return fault

    def watchdog(self, now: float) -> Reason | None:
        """Return a fault if poses or readings of the controls have ceased, else None."""
        timeout = self._settings.gate.timeout
        if self._gate.stale(now):
            return Reason.of(TeleopReason.POSE_SILENT, timeout=timeout)
        if now - self._inputs_stamp > timeout:  # Without readings, the operator could not stop the arm by a button.
            return Reason.of(TeleopReason.INPUTS_SILENT, timeout=timeout)
        return None

    def change(self, cause: Cause, now: float, reason: Reason) -> None:
        """Change the state by a cause that does not engage the arm. Presses that are not finished are dropped."""
        self._gestures.cancel()
        self._presses.clear()
        self.gripped = None
        self.go(cause, now, reason)
        if self.state is ArmState.STOPPED:
            self._analog.forget()

    def record_event(self, now: float, reason: Reason) -> None:
        """Record an event for the operator. The state stays the same."""
        self.events.append(Event(now, self.arm, self.state, self.state, reason))

    def take_presses(self, now: float) -> list[Press]:
        """Return the gestures since the previous call. The caller passes them to :meth:`act`, or drops them."""
        presses, self._presses = self._presses + self._gestures.due(now), []
        if (stuck := self._gestures.take_stuck(now)) is not None:
            self.record_event(now, Reason(TeleopReason.NOT_ENGAGED, cause=stuck))
        return presses

    def press_to_engage(self) -> None:
        """Act as if the hand pressed the button that engages. Nothing happens if no button engages."""
        bound = self._settings.bindings.bound()
        self._presses += [Press(one.control, one.gesture) for one in bound if one.action is Action.PAUSE_TOGGLE][:1]

    def forget(self) -> None:
        """Forget all samples. A control counts again only after a reading has shown it released."""
        self._gate.reset()
        self.motion.forget()
        self._inputs_stamp = -math.inf
        self._gestures.forget()
        self._held.forget()
        self._analog.forget()
        self._presses.clear()
        self.gripped = None

    def act(self, presses: Iterable[Press], around: ArmMeasurements, now: float, chord: bool) -> None:
        """Change the state of the arm as this hand's gestures and the alignment chord ask, and move the gripper.

        Args:
            presses: The gestures of this hand.
            around: The measured and the commanded tool poses, and the reasons why arms may not be engaged.
            now: The time [s].
            chord: Whether either hand holds the alignment chord.
        """
        if self.gripped is False:
            self.go(Cause.LET_GO, now, Reason(TeleopReason.DEAD_MAN_RELEASED))
        if chord:
            self._aligned_at = now
            # While the gesture of this hand is not decided yet, the other hand's chord does not count.
            if self.state is not ArmState.PAUSING or self.chord:
                self.go(Cause.CHORD, now, Reason(TeleopReason.ALIGNMENT_CHORD))
        elif self.state is ArmState.ALIGNING and self._gate.pose is not None and self._gate.stamp >= self._aligned_at:
            self._engage(Cause.ALIGNED, around, now, Reason(TeleopReason.ALIGNED))
        elif self.gripped:
            self._engage(Cause.ENGAGE, around, now, Reason(TeleopReason.DEAD_MAN_HELD))
        self.gripped = None
        for press in presses:
            self._press(press, around, now)
        if self.state is not ArmState.STOPPED:
            self.gripper = self._analog.opening(self.gripper, now)

    def target(self, now: float, expected: Pose | None = None) -> Pose:
        """Return the target pose of an engaged arm's tool, or of the frame between two tools that carry one object.

        The pose is in the world frame.

        Args:
            now: The time [s].
            expected: See :meth:`HandMotion.target`.
        """
        return self.motion.target(self._gate.pose, expected, self._shares(), now)

    def _press(self, press: Press, around: ArmMeasurements, now: float) -> None:
        control, gesture = press
        action = self._settings.bindings.action_of(control, gesture)
        pauses = self._settings.bindings.action_of(control, Gesture.TAP) is Action.PAUSE_TOGGLE
        reason = pressed(control)
        if gesture is Gesture.DOWN:
            if pauses:
                self.go(Cause.PAUSE_BEGINS, now, reason)
        elif pauses and self.state is ArmState.PAUSING:
            self.go(Cause.PAUSE, now, reason)
        elif action is Action.GRIPPER_TOGGLE:
            self.gripper = CLOSED if self.gripper == OPEN else OPEN
        elif action is Action.PAUSE_TOGGLE:
            self._engage(Cause.ENGAGE, around, now, reason)

    def _engage(self, cause: Cause, around: ArmMeasurements, now: float, reason: Reason) -> None:
        if next_state(self.state, cause) is self.state:
            return
        obstacle = around.obstacles.get(self.arm) or self.watchdog(now)
        anchor = around.last_target(self.arm) if self.state is ArmState.POLICY else around.anchor(self.arm)
        if self._gate.pose is None:
            obstacle = obstacle or self._gate.problem
        elif anchor is None or not np.isfinite(anchor.tool.homogeneous).all():
            obstacle = obstacle or Reason(TeleopReason.TOOL_UNKNOWN)
        else:
            self.offset = anchor.offset
            self.motion.anchor(self._gate.pose, floats_of(anchor.tool), self._shares(), now)
        refusal = Reason(TeleopReason.NOT_ENGAGED, cause=obstacle)
        if obstacle is None:
            self.go(cause, now, reason)
        elif self.state is ArmState.ALIGNING:
            self.go(Cause.NOT_ALIGNED, now, refusal)
        else:
            self.record_event(now, refusal)

    def _shares(self) -> Shares:
        held = self._held.actions
        share = self._settings.precision_scale if Action.PRECISION in held else 1.0
        return 0.0 if Action.TRANSLATION_LOCK in held else share, 0.0 if Action.ROTATION_LOCK in held else share

    def go(self, cause: Cause, now: float, reason: Reason) -> None:
        """Change the state by ``cause``. Presses that are not finished are kept."""
        state = next_state(self.state, cause)
        if state is not self.state:
            self.events.append(Event(now, self.arm, self.state, state, reason))
            self.state = state


def pressed(control: str) -> Reason:
    return Reason.of(TeleopReason.PRESSED, control=f"{control} button" if control in BUTTONS else control)


def of_controls(settings: TeleopSettings) -> tuple[object, ...]:
    """Return the settings of buttons, triggers and gestures, so that two of these tuples can be compared."""
    return settings.bindings, settings.chord_window, settings.hold_time, settings.gripper_speed
