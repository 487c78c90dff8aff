"""The sentences of events and reasons, for people: nothing decides by them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.types import ActiveLimit, LimitKind

_K = ReasonKind
_AWAY = (
    "{distance:.3f} m and {angle:.2f} rad from the tool; to be followed it has to begin anew "
    "within {engage_distance:g} m and {engage_angle:g} rad"
)
# Fields are those of the reason's detail; ``cause`` is the sentence of its cause.
SENTENCES: dict[ReasonKind, str] = {
    _K.PRESSED: "{control}",
    _K.COMMANDED: "{action} ({control})",
    _K.DEAD_MAN_HELD: "dead man held",
    _K.DEAD_MAN_RELEASED: "dead man let go",
    _K.ALIGNMENT_CHORD: "alignment chord",
    _K.ALIGNED: "aligned anew",
    _K.CARRY_BEGAN: "carries both tools",
    _K.CARRIED_BY: "carries with the {arm} arm",
    _K.CARRY_ENDED: "the other arm was stopped",
    _K.RESET_SERVICE: "the reset service",
    _K.PAUSE_SERVICE: "the pause service",
    _K.HOMING: "way home",
    _K.HOMING_ARRIVED: "at home",
    _K.HOMING_HELD_UP: "held up by {by}",
    _K.HOMING_NO_WAY: "no free way was found",
    _K.HOMING_INTERRUPTED: "the way home was interrupted",
    _K.HOMING_ENDED: "the way home was ended",
    _K.HOMING_FAULT: "on the way home: {cause}",
    _K.EPISODE_BEGINS: "episode begins",
    _K.EPISODE_ENDS: "episode ends",
    _K.EPISODE_SUCCEEDED: "episode succeeded",
    _K.EPISODE_FAILED: "episode failed",
    _K.EPISODE_DISCARDED: "episode discarded",
    _K.MARK: "mark",
    _K.VERDICT: "verdict on episode {episode}: {line}",
    _K.HOME_REQUESTED: "a program asks for the way home",
    _K.SETTINGS_REQUESTED: "a program changes settings: {changes}",
    _K.CONTROL_REQUESTED: "a program changes control: {changes}",
    _K.SETTINGS_CHANGED: "settings changed",
    _K.CONTROL_CHANGED: "control changed",
    _K.NOT_ENGAGED: "not engaged: {cause}",
    _K.NOT_HOMING: "not homing: {cause}",
    _K.NOT_CARRIED: "not carried: {cause}",
    _K.NOT_CHANGED: "not changed: {cause}",
    _K.NO_RECORDING: "not recorded: this run has no recording",
    _K.RECORDING_ENDED: "not recorded any more: {text}",
    _K.NO_EPISODE: "not discarded: no episode has begun",
    _K.POSE_SILENT: "no pose for {timeout:g} s",
    _K.POSE_GAP: "no pose for {gap:.3f} s",
    _K.INPUTS_SILENT: "no button data for {timeout:g} s",
    _K.POSE_WITHOUT_STAMP: "a pose without a receipt time",
    _K.POSE_UNUSABLE: "a pose that is not finite or not a rotation",
    _K.NO_POSE: "the newest pose is not usable",
    _K.HAND_FROZEN: "the hand's pose is frozen",
    _K.HAND_FRAME_MOVED: "both hands moved as one, as when their frame moves: align",
    _K.HAND_JUMPED: "the hand jumped {distance:.3f} m",
    _K.HAND_ROTATION_JUMPED: "the hand's rotation jumped {angle:.2f} rad",
    _K.HAND_TOO_FAST: "the hand moved at {speed:.1f} m/s",
    _K.HAND_TURNS_TOO_FAST: "the hand turned at {speed:.0f} rad/s",
    _K.CONNECTION_LOST: "connection lost",
    _K.LOOP_STALLED: "the control loop stood still for {duration:.3f} s",
    _K.NODE_STALLED: "this node stood still for {duration:.2f} s",
    _K.CLOCK_NOT_FINITE: "the clock is not finite",
    _K.CLOCK_WENT_BACK: "the clock went back by {duration:.3f} s",
    _K.LINKED: "linked to {arm}: {cause}",
    _K.TOOL_UNKNOWN: "the tool's pose is not known",
    _K.CONTROLS_HELD: "{controls} held since the hand was first heard of: let go first",
    _K.STOPPED: "stopped, {control} goes on",
    _K.ALIGNING: "an alignment is not over",
    _K.CARRYING: "two arms carry",
    _K.ENGAGE_FIRST: "engage the arm first",
    _K.ONE_ARM: "this program drives one arm only",
    _K.OTHER_ARM_BUSY: "the other arm is {state}",
    _K.TOOL_HELD_UP: "a tool is held up on the way to its target",
    _K.ARMS_MUST_HOLD: "stance, axes and controls may be changed while both arms hold",
    _K.CONTROL_REFUSED: "{text}",
    _K.NO_SUBSCRIBER: "{text}",
    _K.NO_TOOL_POSE: "the tool's pose is not known: {text}",
    _K.NO_TRANSFORM: "no transform from {frame} to {world} on /tf",
    _K.HAND_SILENT: "{text}",
    _K.SEVERAL_PUBLISHERS: "{text}",
    _K.CONTROLLER_REFUSES: "{text}",
    _K.BAD_JOINT_STATES: "{text}",
    _K.NO_STATES_YET: "no joint states yet{source}",
    _K.STATES_SILENT: "no joint states{source} for {age:.3f} s; allowed: {timeout:g}",
    _K.STATE_NOT_FINITE: "measured {quantity} of {joint} = {value} for more than {bridged:g} ms; "
    "allowed: finite numbers",
    _K.STATE_JUMPED: "{joint} jumped by {distance:.3f} rad",
    _K.JOINT_STATES: "joint states: {cause}",
    _K.OFF_REFERENCE: "{joint} is {deviation:.3f} rad from its reference for {time:.1f} s; "
    "allowed: {allowed:g} rad for {allowed_time:g} s",
    _K.TOO_CLOSE: "measured: {pair} are {distance:.4f} m apart; "
    "allowed: {allowed:.4f}, {key} {kept:g} less distance_tolerance {tolerance:g}",
    _K.LEFT_BEHIND: "{arm}: the tool is {distance:.3f} m and {angle:.2f} rad from where it was led; "
    "begins anew where it is",
    _K.RUN_ENDED: "the run has ended",
    _K.STOP_SERVICE: "stopped by ~/stop; ~/reset activates again",
    _K.ACTIVATED: "active: the reference starts at the measured posture",
    _K.HOMING_OUTCOME: "homing ended: {cause}",
    _K.CONTROLLER_PHASE: "the controller is {phase}",
    _K.CONTROLLER_PAUSED: "the controller is paused",
    _K.ARMS_HOMING: "the arms are on their way home",
    _K.ARMS_BRAKING: "the arms are braking",
    _K.STREAM_AWAY: "the stream is " + _AWAY,
    _K.PUBLISHER_CHANGED: "another publisher took over{source}; the targets have to begin anew",
    _K.TWO_PUBLISHERS: "two publishers at a time{source}; allowed: one",
    _K.TARGETS_CEASED: "{arm}: targets{source} have ceased, the arm holds",
    _K.TARGETS_LINKED: "{arm}: the arm holds because it is linked to {other}: {cause}",
    _K.TARGET_LATE: "{late:.2f} s late; its sender or this node stood still",
    _K.TARGET_FRAME: "frame_id {frame!r}; allowed: {allowed!r}",
    _K.TARGET_NOT_A_POSE: "not a finite pose with a unit quaternion",
    _K.OTHER: "{text}",
}
_LIMITS = {LimitKind.POSITION: "position", LimitKind.VELOCITY: "velocity", LimitKind.ACCELERATION: "acceleration"}


def sentence(reason: Reason) -> str:
    """One line, in present English."""
    fields: dict[str, Any] = {name: _text(value) for name, value in reason.detail.items()}
    if reason.cause is not None:
        fields["cause"] = sentence(reason.cause)
    return SENTENCES[reason.kind].format(**fields)


def _text(value: Any) -> Any:
    """A list as its names, a mapping as JSON; numbers are formatted by their sentence."""
    if isinstance(value, Mapping):
        return json.dumps(value)
    return " and ".join(map(str, value)) if isinstance(value, list | tuple) else value


def event_line(event: Event) -> str:
    """What an arm does now, and why."""
    return f"{event.destination}: {sentence(event.reason)}"


def limit_name(limit: ActiveLimit) -> str:
    """What held a step back: ``left_A2 velocity``, ``left_link_5|table``."""
    if limit.kind is LimitKind.SEPARATION:
        return "|".join(limit.names)
    return f"{limit.names[0]} {_LIMITS[limit.kind]}"
