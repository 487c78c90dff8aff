"""Sentences about the arms of a run: the reason for the state of each arm, and the next steps of its operator."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from q2r2_control.config.bindings import MEANINGS, Action, BindingSettings
from q2r2_control.device_words import NO_WORDS, DeviceWords
from q2r2_control.events import Event, Reason
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.arm_states import HOLDING, ArmState, is_refusal
from q2r2_control.teleop.reasons import SILENCES, TeleopReason
from q2r2_control.types import ActiveLimit, LimitKind
from q2r2_control.wording import sentence

# A tool within this distance [m] and angle [rad] of its target counts as following. Otherwise the sentence names what
# holds the tool back.
_FOLLOWS, _TURNED = 0.005, 0.05
_ANSWER_S = 4.0  # If a paused arm is asked to pause, the answer "already paused" is shown for this time.
_PAUSES = (TeleopReason.PAUSE_REQUESTED, TeleopReason.PAUSE_SERVICE)
_HELD_BY = {LimitKind.POSITION: "at its limit", LimitKind.VELOCITY: "as fast as it may turn"}
_FOLLOWS_WHAT = {str(ArmState.CARRIED): "goes with the other arm", str(ArmState.POLICY): "follows the policy"}


class Told(NamedTuple):
    """The events of an arm that say why it is in its state."""

    change: Event | None = None  # The last change of state.
    refusal: Event | None = None  # The newest refusal since this change.
    pause: Event | None = None  # The newest request to pause the arm, if it came after the change and while it held.

    def after(self, event: Event) -> Told:
        """Return the events that say why the arm is in its state after one more ``event``.

        If ``event`` changes the arm's state, it replaces all earlier events. Otherwise the last change of state is
        kept. A refusal, or a request to pause an arm that already holds, is added to this change.
        """
        if event.source != event.destination:
            return Told(event)
        if event.kind in _PAUSES and event.destination in HOLDING:
            return self._replace(pause=event)
        return Told(self.change, event) if is_refusal(event) else self

    @property
    def events(self) -> tuple[Event, ...]:
        return tuple(event for event in (self.change, self.refusal) if event is not None)


def told_after(told: Mapping[str, Told], events: Iterable[Event]) -> dict[str, Told]:
    """Return, by arm, the events that say why it is in its state after ``events``. ``told`` are the events before."""
    newest = dict(told)
    for event in events:
        newest[event.arm] = newest.get(event.arm, Told()).after(event)
    return newest


class ArmWords:
    """Makes sentences about the arms of one run, in the words of the device that drives them."""

    def __init__(
        self, joints: Mapping[str, Collection[str]], bindings: BindingSettings, device: DeviceWords = NO_WORDS
    ) -> None:
        """Prepare the sentences.

        Args:
            joints: The joint names of each arm.
            bindings: The action of each control of the headset.
            device: The words of the device that drives.
        """
        self._joints, self._bindings, self._device = joints, bindings, device
        self.told: Mapping[str, Told] = {}  # For each arm, the events that say why it is in its state.

    def follow(self, events: Iterable[Event]) -> None:
        """Keep each of the newest ``events`` that says why an arm is in its state."""
        self.told = told_after(self.told, events)

    def controls(self) -> dict[str, str]:
        """Return the controls of a hand that are bound to an action, and these actions. Both are in words."""
        bound = {self._device.noun(binding.words): MEANINGS[binding.action] for binding in self._bindings.bound()}
        both = [self._device.noun(control) for control in ("lower", "upper") if control in self._device.nouns]
        chord = {} if len(both) < 2 else {" and ".join(both): "the headset's alignment: stops both arms until let go"}
        return bound | chord

    def why(self, tick: Tick, arm: str, binding: Collection[ActiveLimit]) -> str:
        """Return why ``arm`` is in its state, in words. ``binding`` are the limits that held the last steps back."""
        if not tick.following:
            return "the run ends"
        if tick.states[arm] in (ArmState.ALIGNING, ArmState.HOMING):
            return tick.states[arm]
        if not tick.engaged[arm]:
            told = self.told.get(arm, Told())
            sentences = [self._sentence(event.reason) for event in told.events] or ["not engaged yet"]
            answered = told.pause is not None and tick.t - told.pause.t < _ANSWER_S
            return "; ".join([*sentences, *(["already paused"] if answered else [])])
        distance, angle = tick.tracking_error(arm)
        if not (distance > _FOLLOWS or angle > _TURNED):
            return _FOLLOWS_WHAT.get(tick.states[arm], "follows the hand")
        held_by = _held_by(tick, arm, self._joints[arm], binding)
        return held_by or ("catches up" if np.isfinite(distance) else "holds")

    def is_silent(self, tick: Tick, arm: str) -> bool:
        """Return whether ``arm`` is lost because the data of its hand did not come in time."""
        change = self.told.get(arm, Told()).change
        return tick.states[arm] == ArmState.LOST and change is not None and change.kind in SILENCES

    def _sentence(self, reason: Reason) -> str:
        if reason.kind is TeleopReason.DEAD_MAN_RELEASED and (control := self._bindings.words_of(Action.DEAD_MAN)):
            return f"{self._device.noun(control)} let go"
        return sentence(reason, self._device)

    def next_press(self, tick: Tick, arm: str) -> str:
        """Return what the operator of an arm can press next, and the effect of each press."""
        state, device, bindings = tick.states[arm], self._device, self._bindings
        if device.nobody:
            return f"nothing: {device.nobody}"
        if not tick.connected and device.absent:
            return device.absent
        if state == ArmState.ALIGNING:
            return "release both buttons to go on"
        if state == ArmState.HOMING:
            return "any press stops the way home"
        if state == ArmState.CARRIED and (control := bindings.words_of(Action.CARRY)):
            return f"{device.press(control)} of either hand to end it, or pause"
        if state == ArmState.STOPPED and (control := bindings.words_of(Action.STOP)):
            return f"{device.press(control)} to go on"
        moves = state in (ArmState.ENGAGED, ArmState.PAUSING)
        steps = []
        if control := bindings.words_of(Action.PAUSE_TOGGLE):
            steps.append(f"{device.press(control)} to {'pause' if moves else 'engage'}")
        if control := bindings.words_of(Action.DEAD_MAN):
            steps.append(f"let go of {device.noun(control)} to pause" if moves else f"{device.hold(control)} to engage")
        if control := bindings.words_of(Action.GRIPPER_TOGGLE):
            closed = tick.targets[arm].gripper < 0.5
            steps.append(f"{device.press(control)} to {'open' if closed else 'close'} the gripper")
        return ", ".join(steps)


def _held_by(tick: Tick, arm: str, joints: Collection[str], binding: Collection[ActiveLimit]) -> str | None:
    """Return in words what holds an arm back: a pair of bodies first, then the tool speed, then a joint.

    ``joints`` are the names of the arm's joints. The result is None if nothing holds the arm back.
    """
    report = tick.reference.report
    pairs = [limit.names for limit in binding if limit.kind is LimitKind.SEPARATION]
    pairs = [pair for pair in pairs if any(body.startswith(f"{arm}_") for body in pair)]
    if report.tightest_pair in pairs:
        return f"held by {' | '.join(report.tightest_pair)}, {1e3 * report.margin:.0f} mm to spare"
    if pairs:
        return f"held by {' | '.join(pairs[0])}"
    if any(limit.kind is LimitKind.TOOL_SPEED and limit.names == (arm,) for limit in binding):
        return "its tool is as fast as it may be"
    for kind, words in _HELD_BY.items():
        if mine := [limit.names[0] for limit in binding if limit.kind is kind and limit.names[0] in joints]:
            return f"{mine[0]} {words}"
    return None
