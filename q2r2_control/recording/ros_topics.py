"""What is recorded of the ROS nodes: their topics and types, and what the numbers of their arrays stand for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from q2r2_control.recording.messages import ARRAY, HAND_INPUTS, JOINTS, PICTURE, POSE, TEXT, TRAJECTORY
from q2r2_control.recording.topics import (
    DESCRIPTION,
    JOINT_STATES,
    REFERENCE,
    Topic,
    hand_buttons,
    hand_pose,
    numbered,
    safe_target,
    target,
)
from q2r2_control.types import SIDES

CONTROLLER_TICK = "/cartesian_controller/tick"
RECORDER = "/recorder"
RECORDER_EVENTS = f"{RECORDER}/events"
_NODES = ("mujoco_robot", "cartesian_controller", "tcp_endpoint", "simulation_input", "hand_input", "recorder")

# `index` counts the ticks that moved the reference, `dt` is since the last of them; `rejected` is of each arm.
TICK_FIELDS = (
    *("index", "now", "dt", "step", "compute_time", "solve_time", "status", "certified", "fallback"),
    *("closest_distance", "margin", "slack"),
)
ARM_FIELDS = ("engaged", "slip", "slip_angle", "wanted", "measured")  # the last two are openings, 0 closed .. 1 open

_BOOL, _TWIST, _IMAGE = "std_msgs/msg/Bool", "geometry_msgs/msg/Twist", "sensor_msgs/msg/Image"
_TRANSFORMS, _DIAGNOSTICS = "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray"
_HAPTIC = "quest2ros/msg/OVR2ROSHapticFeedback"


def tick_fields(arms: Sequence[str]) -> tuple[str, ...]:
    """The numbers of the controller's tick, in their order."""
    return (*TICK_FIELDS, *(f"rejected_{arm}" for arm in arms))


def arm_flags(arm: str) -> str:
    """The topic of what an arm's teleoperation says of each of its ticks."""
    return f"/q2r2/{arm}/flags"


def arm_events(arm: str) -> str:
    """The topic of an arm's events, as JSON."""
    return f"/q2r2/{arm}/events"


def asked_target(arm: str) -> str:
    """The topic on which an arm's node says for a recording what it asks for, while it does.

    The recorder does not listen to :func:`target` itself, where it would count as the arm's controller.
    """
    return f"/q2r2/{arm}/asked_target"


def heard_on(topic: str) -> str:
    """The topic that the recorder listens to for a recorded one."""
    arm = _arm_of(topic)
    return asked_target(arm) if topic == target(arm) else topic


def ros_topics(arms: Sequence[str], cameras: Mapping[str, str]) -> tuple[Topic, ...]:
    """All topics of a recording of the nodes; ``cameras``: name -> topic of its pictures."""
    types: dict[str, str] = {DESCRIPTION: TEXT, JOINT_STATES: JOINTS, "/mujoco_robot/external_torque": JOINTS}
    types |= {"/tf": _TRANSFORMS, "/tf_static": _TRANSFORMS, "/diagnostics": _DIAGNOSTICS}
    for hand in SIDES:
        types |= {hand_pose(hand): POSE, hand_buttons(hand): HAND_INPUTS}
        types |= {f"/q2r_{hand}_hand_twist": _TWIST, f"/q2r_{hand}_hand_haptic_feedback": _HAPTIC}
    types |= {CONTROLLER_TICK: ARRAY, REFERENCE: TRAJECTORY, RECORDER_EVENTS: TEXT}
    for arm in arms:
        types |= {target(arm): POSE, safe_target(arm): POSE, f"/cartesian_controller/following/{arm}": _BOOL}
        types |= {arm_flags(arm): ARRAY, arm_events(arm): TEXT}
    types |= {f"/{node}/state": TEXT for node in (*_NODES, *(f"{arm}_q2r2_arm_controller" for arm in arms))}
    types |= {topic: PICTURE if is_compressed(topic) else _IMAGE for topic in cameras.values()}
    labels = {CONTROLLER_TICK: tick_fields(arms)} | {arm_flags(arm): ARM_FIELDS for arm in arms}
    return tuple(numbered(types, labels).values())


def is_compressed(topic: str) -> bool:
    """Whether a camera's topic carries CompressedImage, as image_transport names those."""
    return topic.endswith("/compressed")


def is_latched(topic: str) -> bool:
    """Whether its last message is for those that subscribe later too."""
    return topic in (DESCRIPTION, "/tf_static") or topic.startswith("/cartesian_controller/following/")


def is_reliable(topic: Topic) -> bool:
    """Whether all of its messages are to arrive, at no one's cost: none that commands, and none of a stream."""
    return topic.type in (ARRAY, TEXT) or topic.name == REFERENCE or heard_on(topic.name) != topic.name


def _arm_of(topic: str) -> str:
    """Whose topic it is, if it is an arm's."""
    return topic.removeprefix("/q2r2/").split("/")[0]
