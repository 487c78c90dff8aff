"""Events of the arms as data: a kind and its details. Code decides by the kind, and :mod:`wording` makes sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class ReasonKind(StrEnum):
    """The kinds of reasons: for a change of an arm's state, for a refusal, for a result, or for a fault.

    The values never change, so that old recordings stay readable. Each kind has the ``template`` of its sentence. The
    fields of the template are the details of the reason, and ``cause`` is the sentence of its cause.
    """

    template: str

    def __new__(cls, value: str, template: str = "") -> ReasonKind:
        kind = str.__new__(cls, value)
        kind._value_, kind.template = value, template
        return kind

    # An operator's controls.
    PRESSED = "pressed", "{control}"
    COMMANDED = "commanded", "{action} ({control})"  # The action concerns both arms.
    DEAD_MAN_HELD = "dead_man_held", "dead man held"
    DEAD_MAN_RELEASED = "dead_man_released", "dead man let go"
    ALIGNMENT_CHORD = "alignment_chord", "alignment chord"
    ALIGNED = "aligned", "aligned anew"
    CARRY_BEGAN = "carry_began", "carries both tools"
    CARRIED_BY = "carried_by", "carries with the {arm} arm"
    CARRY_ENDED = "carry_ended", "the other arm was stopped"
    RESET_SERVICE = "reset_service", "the reset service"
    PAUSE_SERVICE = "pause_service", "the pause service"
    # The way home.
    HOMING = "homing", "way home"
    HOMING_ARRIVED = "homing_arrived", "at home"
    HOMING_HELD_UP = "homing_held_up", "held up by {by}"
    HOMING_NO_WAY = "homing_no_way", "no free way was found"
    HOMING_INTERRUPTED = "homing_interrupted", "the way home was interrupted"
    HOMING_ENDED = "homing_ended", "the way home was ended"
    HOMING_FAULT = "homing_fault", "on the way home: {cause}"
    # The recording.
    EPISODE_BEGINS = "episode_begins", "episode begins"
    EPISODE_ENDS = "episode_ends", "episode ends"
    EPISODE_SUCCEEDED = "episode_succeeded", "episode succeeded"
    EPISODE_FAILED = "episode_failed", "episode failed"
    EPISODE_DISCARDED = "episode_discarded", "episode discarded"
    MARK = "mark", "mark"
    SUBTASK_BEGINS = "subtask_begins", "begins: {name}"
    VERDICT = "verdict", "verdict on episode {episode}: {line}"
    # Cameras of a recording. No arm stops for them.
    CAMERA_STOPPED = "camera_stopped", "camera {camera}: no picture for {age:.1f} s{why}"
    CAMERA_SLOW = "camera_slow", "camera {camera}: {rate:.1f} pictures a second instead of {due:g}"
    CAMERA_OTHER_SIZE = (
        "camera_other_size",
        "camera {camera}: pictures of {width}x{height}; allowed: {allowed_width}x{allowed_height}",
    )
    CAMERA_BACK = "camera_back", "camera {camera}: pictures again after {gap:.1f} s, {missing} missing"
    # Requests of a program.
    HOME_REQUESTED = "home_requested", "a program asks for the way home"
    ENGAGE_REQUESTED = "engage_requested", "a program presses for both hands"
    PAUSE_REQUESTED = "pause_requested", "a program asks for a pause"
    POLICY_REQUESTED = "policy_requested", "a program gives the arms to the policy"
    RECORDING_REQUESTED = "recording_requested", "a program asks for {action}"
    SETTINGS_REQUESTED = "settings_requested", "a program changes settings: {changes}"
    CONTROL_REQUESTED = "control_requested", "a program changes control: {changes}"
    OBSTACLE_REPORTED = "obstacle_reported", "a program reports {name}"
    OBSTACLE_IN_THE_WAY = "obstacle_in_the_way", "{name} is in the way: {pair}"
    SETTINGS_CHANGED = "settings_changed", "settings changed"
    CONTROL_CHANGED = "control_changed", "control changed"
    # A warning, which stops nothing.
    HANDS_CROSSED = (
        "hands_crossed",
        "the left hand has been to the right of the right hand for {time:g} s: are the two controllers swapped?",
    )
    # Refusals: nothing changed. Those of the first group have a cause.
    NOT_ENGAGED = "not_engaged", "not engaged: {cause}"
    NOT_HOMING = "not_homing", "not homing: {cause}"
    NOT_CARRIED = "not_carried", "not carried: {cause}"
    NOT_CHANGED = "not_changed", "not changed: {cause}"
    POLICY_REFUSED = "policy_refused", "the policy does not act: {cause}"
    NO_RECORDING = "no_recording", "not recorded: this run has no recording"
    RECORDING_ENDED = "recording_ended", "not recorded any more: {text}"
    NO_EPISODE = "no_episode", "not discarded: no episode has begun"
    NO_OPEN_EPISODE = "no_open_episode", "no next subtask: no episode goes on"
    LAST_SUBTASK = "last_subtask", "no next subtask: {name} is the last one"
    # Faults of a hand and its data.
    POSE_SILENT = "pose_silent", "no pose for {timeout:g} s"
    POSE_GAP = "pose_gap", "no pose for {gap:.3f} s"
    INPUTS_SILENT = "inputs_silent", "no button data for {timeout:g} s"
    POSE_WITHOUT_STAMP = "pose_without_stamp", "a pose without a receipt time"
    POSE_UNUSABLE = "pose_unusable", "a pose that is not finite or not a rotation"
    NO_POSE = "no_pose", "the newest pose is not usable"
    HAND_FROZEN = "hand_frozen", "the hand's pose is frozen"
    HAND_FRAME_MOVED = "hand_frame_moved", "both hands moved as one, as when their frame moves: align"
    HAND_UNTRACKED = "hand_untracked", "the headset does not see the hand"
    HAND_JUMPED = "hand_jumped", "the hand jumped {distance:.3f} m"
    HAND_ROTATION_JUMPED = "hand_rotation_jumped", "the hand's rotation jumped {angle:.2f} rad"
    HAND_TOO_FAST = "hand_too_fast", "the hand moved at {speed:.1f} m/s"
    HAND_TURNS_TOO_FAST = "hand_turns_too_fast", "the hand turned at {speed:.0f} rad/s"
    # A policy and its actions.
    POLICY_ACTS = "policy_acts", "the policy acts"
    POLICY_SILENT = "policy_silent", "no action of the policy that counts for {timeout:g} s"
    POLICY_UNUSABLE = "policy_unusable", "actions of the policy that cannot be used: {text}"
    POLICY_JUMPED = (
        "policy_jumped",
        "an action of the policy is {distance:.3f} m and {angle:.2f} rad from {what}; "
        "allowed: {allowed:g} m and {allowed_angle:g} rad",
    )
    CONNECTION_LOST = "connection_lost", "connection lost"
    LOOP_STALLED = "loop_stalled", "the control loop stood still for {duration:.3f} s"
    NODE_STALLED = "node_stalled", "this node stood still for {duration:.2f} s"
    CLOCK_NOT_FINITE = "clock_not_finite", "the clock is not finite"
    CLOCK_WENT_BACK = "clock_went_back", "the clock went back by {duration:.3f} s"
    LINKED = "linked", "linked to {arm}: {cause}"
    # Obstacles to a request.
    TOOL_UNKNOWN = "tool_unknown", "the tool's pose is not known"
    CONTROLS_HELD = "controls_held", "{controls} held since the hand was first heard of: let go first"
    STOPPED = "stopped", "stopped, {control} goes on"
    ALIGNING = "aligning", "an alignment is not over"
    CARRYING = "carrying", "two arms carry"
    ENGAGE_FIRST = "engage_first", "engage the arm first"
    ONE_ARM = "one_arm", "this program drives one arm only"
    OTHER_ARM_BUSY = "other_arm_busy", "the other arm is {state}"
    TOOL_HELD_UP = "tool_held_up", "a tool is held up on the way to its target"
    ARMS_MUST_HOLD = "arms_must_hold", "stance, axes and controls may be changed while both arms hold"
    CONTROL_REFUSED = "control_refused", "{text}"
    # Obstacles that ROS nodes find. Those of the first group have a cause.
    NO_TOOL_POSE = "no_tool_pose", "the tool's pose is not known: {cause}"
    CONTROLLER_REFUSES = "controller_refuses", "{cause}"
    CONTROLLER_STOPPED = "controller_stopped", "{controller} is stopped: {cause}; call {controller}/reset"
    CONTROLLER_FAULT = "controller_fault", "{controller} is {phase}: {cause}"
    CONTROLLER_SILENT = "controller_silent", "{controller}: {cause}"
    CONTROLLER_ON_PAUSE = "controller_on_pause", "{controller} is paused; call {controller}/pause with data: false"
    CONTROLLER_DEACTIVATED = (
        "controller_deactivated",
        "{controller} is deactivated: ros2 lifecycle set {controller} activate takes over where the arms are",
    )
    CONTROLLER_ABSENT = (
        "controller_absent",
        "{controller} is not there: nobody publishes {topic} ({type}); another controller than the built-in one needs "
        "its preset",
    )
    CONTROLLER_STANDS = (
        "controller_stands",
        "the {arm} arm's controller{takers} stands still: the arm is measured, and does not go the {way:.3f} {unit} "
        "that it was asked to in {time:g} s",
    )
    CONTROLLER_RESTARTED = "controller_restarted", "{controller} was restarted"
    CONTROLLER_ENDED = "controller_ended", "{controller} has ended"
    NODE_BEGINS = "node_begins", "the node has not begun yet"
    NODE_ENDS = "node_ends", "the node ends"
    NO_CURRENT_POSE = "no_current_pose", "current_pose() gives none"
    NO_TRANSFORM = "no_transform", "no transform from {frame} to {world} on /tf"
    TRANSFORM_OLD = "transform_old", "{frame} on /tf{source} is {age:.2f} s old"
    FRAME_DISPUTED = "frame_disputed", "two publishers on /tf say different things of {frame}: end one of {publishers}"
    TOPIC_EMPTY = "topic_empty", "nothing on {topic}"
    TOPIC_SILENT = "topic_silent", "{topic}{source} is silent for {age:.2f} s"
    TOPIC_NOT_A_POSE = "topic_not_a_pose", "{topic}: not finite or not a rotation"
    SAFE_TARGET_AWAY = (
        "safe_target_away",
        "{topic} is {distance:.3f} m and {angle:.2f} rad from {frame}: the arm moves, or {frame} is not the cell's "
        "tool; tool_frame (end_effector_link_name) has to name a frame at the tool of the cell's YAML",
    )
    NO_SUBSCRIBER = "no_subscriber", "{topic} has no subscriber"
    SUBSCRIBER_UNKNOWN = "subscriber_unknown", "{topic} has a subscriber whose node is not known yet"
    SEVERAL_PUBLISHERS = (
        "several_publishers",
        "{count} publishers of {topic}, allowed is one (a killed one counts for some seconds)",
    )
    NOT_ACKNOWLEDGED = "not_acknowledged", "messages on {topic} are not acknowledged for {age:.2f} s"
    NOT_FOLLOWED = "not_followed", "{topic} says that targets are not followed"
    FOLLOWED_NO_MORE = "followed_no_more", "{topic} says that targets are not followed any more"
    NO_POSE_COMMANDS = "no_pose_commands", "{service} has not agreed to this type of targets yet"
    HAND_SILENT = "hand_silent", "no {data} of the {hand} hand{source} for {age:.2f} s"
    HAND_UNKNOWN = "hand_unknown", "no {data} of the {hand} hand{source} yet"
    GRIPPER_FAILED = "gripper_failed", "{text}"
    NO_WAY_HOME = "no_way_home", "this arm's controller has no way home"
    NO_SERVICE = "no_service", "there is no service {service}"
    NO_ANSWER = "no_answer", "{service} does not answer"
    HOMING_NOT_BEGUN = "homing_not_begun", "{controller} did not begin"
    NO_CLOCK = "no_clock", "use_sim_time is set and nothing comes on /clock"
    CLOCK_STANDS = "clock_stands", "use_sim_time is set and the time on /clock stands still"
    NEW_RECEIVER = "new_receiver", "a new receiver takes the commands, and the arms are not where these are"
    OTHER_COMMANDER = "other_commander", "{nodes} commands the arms on {topic}"
    ARMS_MOVE = "arms_move", "the arms do not stand still"
    MESSAGE_UNREADABLE = "message_unreadable", "{topic}: what cannot be read is dropped, such as {text}"
    BAD_JOINT_STATES = "bad_joint_states", "{text}"
    NO_EXTERNAL_TORQUES = "no_external_torques", "no external torques on {topic}"
    # Findings of supervision.
    NO_STATES_YET = "no_states_yet", "no joint states yet{source}"
    STATES_SILENT = "states_silent", "no joint states{source} for {age:.3f} s; allowed: {timeout:g}"
    STATE_NOT_FINITE = (
        "state_not_finite",
        "measured {quantity} of {joint} = {value} for more than {bridged:g} ms; allowed: finite numbers",
    )
    STATE_JUMPED = "state_jumped", "{joint} jumped by {distance:.3f} rad"
    JOINT_STATES = "joint_states", "joint states: {cause}"
    OFF_REFERENCE = (
        "off_reference",
        "{joint} is {deviation:.3f} rad from its reference for {time:.1f} s; "
        "allowed: {allowed:g} rad for {allowed_time:g} s",
    )
    TOO_HEAVY = (
        "too_heavy",
        "{joint} is {deviation:.3f} rad from its reference for {time:.1f} s, "
        "and gravity alone asks it for {needed:.1f} Nm; "
        "allowed: {allowed:g} rad for {allowed_time:g} s, and its torque limit, {limit:g} Nm",
    )
    TOO_CLOSE = (
        "too_close",
        "measured: {pair} are {distance:.4f} m apart; "
        "allowed: {allowed:.4f}, {key} {kept:g} less distance_tolerance {tolerance:g}",
    )
    LEFT_BEHIND = (
        "left_behind",
        "{arm}: the tool is {distance:.3f} m and {angle:.2f} rad from where it was led; begins anew where it is",
    )
    # Cabinets of KUKA's.
    FRI_SILENT = "fri_silent", "{arm}: no FRI message from {source}"
    FRI_UNREADABLE = "fri_unreadable", "{arm}: {source}: {text}"
    FRI_SESSION = (
        "fri_session",
        "{arm}: the cabinet is in {session}, connection {quality}, safety {safety}, drives {drives}; "
        "commands are followed in commanding active, without a stop of the safety controller",
    )
    FRI_COMMAND_MODE = "fri_command_mode", "{arm}: the Sunrise application asks for {asked} commands; allowed: {wanted}"
    FRI_TOO_SELDOM = (
        "fri_too_seldom",
        "{arm}: the cabinet asks every {period:g} ms; allowed for torques: {allowed:g} at most",
    )
    FRI_DROPPED = "fri_dropped", "{arm}: the cabinet ended the session"
    FRI_BEHIND = "fri_behind", "{arm}: the cabinet asks less often than every {period:g} ms, and is {lag:.2f} s behind"
    FRI_OVERTAKEN = "fri_overtaken", "the control loop was too late for the cabinets"
    ARMS_APART = "arms_apart", "{arm}: {skew:.0f} ms behind the other arm; allowed: {allowed:.0f} ms"
    RUN_ENDED = "run_ended", "the run has ended"
    STOP_SERVICE = "stop_service", "the stop service was called"
    ACTIVATED = "activated", "active: the reference starts at the measured posture"
    HOMING_OUTCOME = "homing_outcome", "homing ended: {cause}"
    CONTROLLER_PHASE = "controller_phase", "the controller is {phase}"  # It follows no targets in this phase.
    CONTROLLER_PAUSED = "controller_paused", "the controller is paused"
    ARMS_HOMING = "arms_homing", "the arms are on their way home"
    ARMS_BRAKING = "arms_braking", "the arms are braking"
    STREAM_AWAY = (
        "stream_away",
        "the stream is {distance:.3f} m and {angle:.2f} rad from the tool; to be followed it has to begin anew "
        "within {engage_distance:g} m and {engage_angle:g} rad",
    )
    PUBLISHER_CHANGED = "publisher_changed", "another publisher took over{source}; the targets have to begin anew"
    TWO_PUBLISHERS = "two_publishers", "two publishers at a time{source}; allowed: one"
    TARGETS_CEASED = "targets_ceased", "{arm}: targets{source} have ceased, the arm holds"
    TARGETS_LINKED = "targets_linked", "{arm}: the arm holds because it is linked to {other}: {cause}"
    TARGET_LATE = "target_late", "{late:.2f} s late; its sender or this node stood still"
    TARGET_FRAME = "target_frame", "frame_id {frame!r}; allowed: {allowed!r}"
    TARGET_NOT_A_POSE = "target_not_a_pose", "not a finite pose with a unit quaternion"
    OTHER = "other", "{text}"  # The sentence was made elsewhere, and no code decides by it.


_K = ReasonKind
_NOT_DONE = {_K.NOT_ENGAGED, _K.NOT_HOMING, _K.NOT_CARRIED, _K.NOT_CHANGED, _K.POLICY_REFUSED}
_NOT_RECORDED = {_K.NO_RECORDING, _K.RECORDING_ENDED, _K.NO_EPISODE, _K.NO_OPEN_EPISODE, _K.LAST_SUBTASK}
REFUSALS = frozenset({*_NOT_DONE, *_NOT_RECORDED})
_WAY_HOME = {_K.HOMING, _K.HOMING_ARRIVED, _K.HOMING_HELD_UP, _K.HOMING_NO_WAY, _K.HOMING_INTERRUPTED, _K.HOMING_ENDED}
ROUTINE = frozenset({_K.ACTIVATED, _K.HOMING_ARRIVED, _K.NODE_ENDS})  # Kinds that tell of no fault.
# Requests to hold, and the results of a way home.
HOLD_REQUESTS = frozenset({_K.PAUSE_SERVICE, _K.RESET_SERVICE, *_WAY_HOME})


@dataclass(frozen=True, slots=True)
class Reason:
    """A kind with its details, which are numbers in SI units, texts, names, and lists of these."""

    kind: ReasonKind
    detail: Mapping[str, Any] = field(default_factory=dict)
    cause: Reason | None = None  # The reason from which this one follows.

    @classmethod
    def of(cls, kind: ReasonKind, cause: Reason | None = None, **detail: Any) -> Reason:
        """Make a reason, with its details as keyword arguments."""
        return cls(kind, detail, cause)

    @classmethod
    def in_words(cls, text: str) -> Reason:
        """Make a reason of a sentence by which no code decides."""
        return cls(ReasonKind.OTHER, {"text": text})

    @property
    def root(self) -> Reason:
        return self if self.cause is None else self.cause.root

    def as_json(self) -> dict[str, Any]:
        """Return data for ``json.dumps``. Empty fields are left out."""
        data: dict[str, Any] = {"kind": str(self.kind)}
        if self.detail:
            data["detail"] = dict(self.detail)
        if self.cause is not None:
            data["cause"] = self.cause.as_json()
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Reason:
        """Make the reason from the data of :meth:`as_json`.

        Raises:
            ValueError, KeyError, TypeError: For other data.
        """
        cause = cls.from_json(data["cause"]) if "cause" in data else None
        return cls(ReasonKind(data["kind"]), dict(data.get("detail", {})), cause)


@dataclass(frozen=True, slots=True)
class Event:
    """A change of an arm's state; or news for its operator, if both states are the same."""

    t: float  # [s]
    arm: str
    source: str  # The state before.
    destination: str  # The state after.
    reason: Reason

    @property
    def kind(self) -> ReasonKind:
        return self.reason.kind

    def as_json(self) -> dict[str, Any]:
        """Return data for ``json.dumps``: ``t``, ``arm``, ``from``, ``to``, ``kind``, and ``detail`` and ``cause``."""
        states = {"from": str(self.source), "to": str(self.destination)}
        return {"t": self.t, "arm": self.arm, **states, **self.reason.as_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Event:
        """Make the event from the data of :meth:`as_json`.

        Raises:
            ValueError, KeyError, TypeError: For other data.
        """
        return cls(float(data["t"]), data["arm"], data["from"], data["to"], Reason.from_json(data))
