"""The kinds of reasons for events of teleoperation: controls of the operator, requests of a program, and faults."""

from __future__ import annotations

from q2r2_control.events import CommonReason, ReasonKind


class TeleopReason(ReasonKind):
    """Why an arm's state changes, what is refused, and what a hand or its data lack."""

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
    # The recording.
    EPISODE_BEGINS = "episode_begins", "episode begins"
    EPISODE_ENDS = "episode_ends", "episode ends"
    EPISODE_SUCCEEDED = "episode_succeeded", "episode succeeded"
    EPISODE_FAILED = "episode_failed", "episode failed"
    EPISODE_DISCARDED = "episode_discarded", "episode discarded"
    MARK = "mark", "mark"
    SUBTASK_BEGINS = "subtask_begins", "begins: {name}"
    VERDICT = "verdict", "verdict on episode {episode}: {line}"
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
    # A warning, which stops no arm.
    HANDS_CROSSED = (
        "hands_crossed",
        "the left hand has been to the right of the right hand for {time:g} s: are the two controllers swapped?",
    )
    # Refusals, after which nothing has changed. The first five have a cause.
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
    POLICY_JUMPED = (
        "policy_jumped",
        "an action of the policy is {distance:.3f} m and {angle:.2f} rad from {what}; "
        "allowed: {allowed:g} m and {allowed_angle:g} rad",
    )
    # The connection, the clock and the other arm.
    CONNECTION_LOST = "connection_lost", "connection lost"
    CLOCK_NOT_FINITE = "clock_not_finite", "the clock is not finite"
    CLOCK_WENT_BACK = "clock_went_back", "the clock went back by {duration:.3f} s"
    LINKED = "linked", "linked to {arm}: {cause}"
    # Causes of a refusal: why a request cannot be carried out now.
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


_K = TeleopReason
_NOT_DONE = {_K.NOT_ENGAGED, _K.NOT_HOMING, _K.NOT_CARRIED, _K.NOT_CHANGED, _K.POLICY_REFUSED}
_NOT_RECORDED = {_K.NO_RECORDING, _K.RECORDING_ENDED, _K.NO_EPISODE, _K.NO_OPEN_EPISODE, _K.LAST_SUBTASK}
REFUSALS: frozenset[ReasonKind] = frozenset({*_NOT_DONE, *_NOT_RECORDED})
_C = CommonReason
_WAY_HOME = {_C.HOMING, _C.HOMING_ARRIVED, _C.HOMING_HELD_UP, _C.HOMING_NO_WAY, _C.HOMING_INTERRUPTED, _C.HOMING_ENDED}
# Reasons that say that a hand's data did not come in time.
SILENCES: frozenset[ReasonKind] = frozenset({_K.POSE_SILENT, _K.POSE_GAP, _K.INPUTS_SILENT})
# Requests to let arms hold, the start of a motion home, and its outcomes.
HOLD_REQUESTS: frozenset[ReasonKind] = frozenset({_K.PAUSE_SERVICE, _K.RESET_SERVICE, *_WAY_HOME})
