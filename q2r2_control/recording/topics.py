"""The topics of recordings: of one loop's run, and of the ROS nodes.

All that replay, judge and export read of a loop's run is on ``tick``, ``hand_samples``, ``state`` and the pictures. The
other topics are the same as standard messages, for tools that plot and show them, and named as those of the nodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from q2r2_control.recording.messages import ARRAY, HAND_INPUTS, JOINTS, PICTURE, POSE, TEXT, TRAJECTORY
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, tick_labels
from q2r2_control.types import SIDES

WORLD = "world"  # frame of targets
TICK, SAMPLES, STATE = "/q2r2/tick", "/q2r2/hand_samples", "/q2r2/state"
JOINT_STATES, EXTERNAL_TORQUE = "/joint_states", "/q2r2/external_torque"
JOINT_COMMANDS, REFERENCE, DESCRIPTION = "/joint_commands", "/q2r2/reference", "/robot_description"
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


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    channel: int
    name: str
    type: str
    labels: tuple[str, ...] = ()  # of an array's numbers, in their order


def run_topics(arms: Sequence[str], joints: Sequence[str], cameras: Sequence[str] = ()) -> dict[str, Topic]:
    """Topics of a loop's run by name, in the order in which a tick's messages are written."""
    types = {DESCRIPTION: TEXT, TICK: ARRAY, SAMPLES: ARRAY}
    for hand in SIDES:
        types |= {hand_pose(hand): POSE, hand_buttons(hand): HAND_INPUTS}
    types |= {JOINT_STATES: JOINTS, EXTERNAL_TORQUE: JOINTS}
    for arm in arms:
        types |= {filtered_hand(arm): POSE, target(arm): POSE, safe_target(arm): POSE}
    types |= {REFERENCE: TRAJECTORY, JOINT_COMMANDS: JOINTS, STATE: TEXT}
    types |= {picture_topic(camera): PICTURE for camera in cameras}
    return _numbered(types, {TICK: tick_labels(arms, joints), SAMPLES: SAMPLE_FIELDS})


def ros_topics(arms: Sequence[str], cameras: Mapping[str, str]) -> tuple[Topic, ...]:
    """Topics of a recording of the nodes; ``cameras``: name -> topic of its pictures."""
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
    return tuple(_numbered(types, labels).values())


def _numbered(types: dict[str, str], labels: dict[str, tuple[str, ...]]) -> dict[str, Topic]:
    return {
        name: Topic(channel, name, kind, labels.get(name, ())) for channel, (name, kind) in enumerate(types.items(), 1)
    }


def tick_fields(arms: Sequence[str]) -> tuple[str, ...]:
    """The numbers of :data:`CONTROLLER_TICK`, in their order."""
    return (*TICK_FIELDS, *(f"rejected_{arm}" for arm in arms))


def hand_pose(hand: str) -> str:
    return f"/q2r_{hand}_hand_pose"


def hand_buttons(hand: str) -> str:
    return f"/q2r_{hand}_hand_inputs"


def filtered_hand(arm: str) -> str:
    """Poses of the hand that an arm follows."""
    return f"/q2r2/{arm}/filtered_hand_pose"


def target(arm: str) -> str:
    """What the operator asks of an arm."""
    return f"/q2r2/{arm}/target_frame"


def asked_target(arm: str) -> str:
    """Targets once more, for the recorder, which would count as the arm's controller on :func:`target`."""
    return f"/q2r2/{arm}/asked_target"


def safe_target(arm: str) -> str:
    """An arm's tool at the controller's reference."""
    return f"/cartesian_controller/safe_target/{arm}"


def arm_flags(arm: str) -> str:
    """:data:`ARM_FIELDS` of each tick of an arm's teleoperation."""
    return f"/q2r2/{arm}/flags"


def arm_events(arm: str) -> str:
    """An arm's events, as JSON."""
    return f"/q2r2/{arm}/events"


def picture_topic(camera: str) -> str:
    return f"/{camera}/image/compressed"


def heard_on(topic: str) -> str:
    """The topic that the recorder listens to for a recorded one."""
    arm = topic.removeprefix("/q2r2/").split("/")[0]
    return asked_target(arm) if topic == target(arm) else topic


def is_compressed(topic: str) -> bool:
    """Whether a camera's topic carries CompressedImage, as image_transport names those."""
    return topic.endswith("/compressed")


def is_latched(topic: str) -> bool:
    """Whether its last message is for those that subscribe later too."""
    return topic in (DESCRIPTION, "/tf_static") or topic.startswith("/cartesian_controller/following/")


def is_reliable(topic: Topic) -> bool:
    """Whether all of its messages are to arrive, at no one's cost: none that commands, and none of a stream."""
    return topic.type in (ARRAY, TEXT) or topic.name == REFERENCE or heard_on(topic.name) != topic.name
