"""The kinds of reasons that the ROS nodes give."""

from __future__ import annotations

from q2r2_control.events import CommonReason, ReasonKind
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.teleop.reasons import SILENCES


class RosReason(ReasonKind):
    """What a node misses or refuses, and what it hears of other nodes."""

    # Why arms may not be engaged or commanded, or have to pause.
    NODE_STALLED = "node_stalled", "this node stood still for {duration:.2f} s"
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
    # A stop, and why a target is not used.
    STOP_SERVICE = "stop_service", "the stop service was called"
    TARGET_LATE = "target_late", "{late:.2f} s late; its sender or this node stood still"
    TARGET_FRAME = "target_frame", "frame_id {frame!r}; allowed: {allowed!r}"
    TARGET_NOT_A_POSE = "target_not_a_pose", "not a finite pose with a unit quaternion"


_R, _S = RosReason, SupervisionReason
# Reasons that say only that a node stood still or that data came late. After a stop for such a reason, nobody has to
# look at the arms.
LATENESS: frozenset[ReasonKind] = SILENCES | {
    *(_R.NODE_STALLED, _R.HAND_SILENT, _R.TRANSFORM_OLD),
    *(CommonReason.LOOP_STALLED, _S.STATES_SILENT, _S.TARGETS_CEASED),
}
# Reasons of an arm's node that say that its controller does not follow, but not why. The controller knows why.
NOT_EXPLAINED: frozenset[ReasonKind] = frozenset(
    {_R.FOLLOWED_NO_MORE, _R.NOT_FOLLOWED, _R.NOT_ACKNOWLEDGED, _R.TOPIC_SILENT}
)
