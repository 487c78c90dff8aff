"""Topics of recordings and their messages: ROS 2 messages in CDR, made by rosbags.

A recording contains the run of one loop, or messages of the ROS nodes. The data of a loop's run is on the topics
``tick``, ``hand_samples`` and ``state``, and on the topics of the pictures. The replay, the judge and the export read
these topics. The other topics repeat this data as standard messages, which plotting tools and viewers can show.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.inputs.messages import Dialect, message_types
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, tick_labels
from q2r2_control.types import SIDES, Array

STORE = message_types(Dialect.ROS2)
ARRAY, TEXT, PICTURE = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "sensor_msgs/msg/CompressedImage"
JPEG = "jpeg"  # The usual value of the field ``format`` of a CompressedImage.
POSE, JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"
TRAJECTORY, HAND_INPUTS = "trajectory_msgs/msg/JointTrajectory", "quest2ros/msg/OVR2ROSInputs"
NANOSECONDS = 1_000_000_000
_ENCAPSULATION = 4  # The size of the CDR header, which is before the fields of the message [bytes].
WORLD = "world"  # The frame in which targets are given.
TICK, SAMPLES, STATE = "/q2r2/tick", "/q2r2/hand_samples", "/q2r2/state"
JOINT_STATES, EXTERNAL_TORQUE = "/joint_states", "/q2r2/external_torque"
JOINT_COMMANDS, REFERENCE, DESCRIPTION = "/joint_commands", "/q2r2/reference", "/robot_description"
CONTROLLER_TICK = "/cartesian_controller/tick"
RECORDER = "/recorder"
RECORDER_EVENTS = f"{RECORDER}/events"
_NODES = ("mujoco_robot", "cartesian_controller", "tcp_endpoint", "simulation_input", "hand_input", "recorder")

# The numbers of a controller's tick. `index` counts the ticks that moved the reference, and `dt` is the time since the
# last such tick [s]. tick_fields() adds a field `rejected_...` for each arm.
TICK_FIELDS = (
    *("index", "now", "dt", "step", "compute_time", "solve_time", "status", "certified", "fallback"),
    *("closest_distance", "margin", "slack"),
)
# The last two numbers are openings of the arm's gripper, 0 closed .. 1 open: the wanted and the measured opening.
ARM_FIELDS = ("engaged", "slip", "slip_angle", "wanted", "measured")

_BOOL, _TWIST, _IMAGE = "std_msgs/msg/Bool", "geometry_msgs/msg/Twist", "sensor_msgs/msg/Image"
_TRANSFORMS, _DIAGNOSTICS = "tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray"
_HAPTIC = "quest2ros/msg/OVR2ROSHapticFeedback"


@dataclass(frozen=True)
class Topic:
    channel: int
    name: str
    type: str
    labels: tuple[str, ...] = ()  # The names of an array's numbers, in their order.


def run_topics(
    arms: Sequence[str], joints: Sequence[str], cameras: Sequence[str] = (), depth: Sequence[str] = ()
) -> dict[str, Topic]:
    """Return the topics of a loop's run, by name.

    Args:
        arms: The names of the arms.
        joints: The names of the joints.
        cameras: The cameras whose pictures are recorded.
        depth: The cameras whose depth is recorded too.
    """
    types = {DESCRIPTION: TEXT, TICK: ARRAY, SAMPLES: ARRAY}
    for hand in SIDES:
        types |= {hand_pose(hand): POSE, hand_buttons(hand): HAND_INPUTS}
    types |= {JOINT_STATES: JOINTS, EXTERNAL_TORQUE: JOINTS}
    for arm in arms:
        types |= {filtered_hand(arm): POSE, target(arm): POSE, safe_target(arm): POSE}
    types |= {REFERENCE: TRAJECTORY, JOINT_COMMANDS: JOINTS, STATE: TEXT}
    types |= {picture_topic(camera): PICTURE for camera in cameras}
    types |= {depth_topic(camera): PICTURE for camera in depth}
    return _numbered(types, {TICK: tick_labels(arms, joints), SAMPLES: SAMPLE_FIELDS})


def loop_topics(arms: Sequence[str]) -> tuple[str, ...]:
    """Return the topics on which every run has messages, whatever happens in it."""
    safe_targets = (safe_target(arm) for arm in arms)
    return (DESCRIPTION, TICK, JOINT_STATES, *safe_targets, REFERENCE, JOINT_COMMANDS, STATE)


def ros_topics(arms: Sequence[str], pictures: Iterable[str] = ()) -> tuple[Topic, ...]:
    """Return the topics of a recording of the ROS nodes. ``pictures`` are the names of the topics with pictures."""
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
    types |= {topic: PICTURE if is_compressed(topic) else _IMAGE for topic in pictures}
    labels = {CONTROLLER_TICK: tick_fields(arms)} | {arm_flags(arm): ARM_FIELDS for arm in arms}
    return tuple(_numbered(types, labels).values())


def _numbered(types: dict[str, str], labels: dict[str, tuple[str, ...]]) -> dict[str, Topic]:
    return {
        name: Topic(channel, name, kind, labels.get(name, ())) for channel, (name, kind) in enumerate(types.items(), 1)
    }


def tick_fields(arms: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the numbers in :data:`CONTROLLER_TICK`, in the order of the message."""
    return (*TICK_FIELDS, *(f"rejected_{arm}" for arm in arms))


def hand_pose(hand: str) -> str:
    return f"/q2r_{hand}_hand_pose"


def hand_buttons(hand: str) -> str:
    return f"/q2r_{hand}_hand_inputs"


def filtered_hand(arm: str) -> str:
    """Return the topic of the filtered poses of the hand that an arm follows."""
    return f"/q2r2/{arm}/filtered_hand_pose"


def target(arm: str) -> str:
    """Return the topic of the targets that the operator gives to an arm."""
    return f"/q2r2/{arm}/target_frame"


def asked_target(arm: str) -> str:
    """Return the topic on which an arm's targets are repeated for the recorder.

    If the recorder subscribed to :func:`target`, the recorder would count as the controller of the arm.
    """
    return f"/q2r2/{arm}/asked_target"


def safe_target(arm: str) -> str:
    """Return the topic of an arm's tool pose at the controller's reference."""
    return f"/cartesian_controller/safe_target/{arm}"


def arm_flags(arm: str) -> str:
    """Return the topic with the :data:`ARM_FIELDS` of each tick of an arm's teleoperation."""
    return f"/q2r2/{arm}/flags"


def arm_events(arm: str) -> str:
    """Return the topic of an arm's events, as JSON."""
    return f"/q2r2/{arm}/events"


def picture_topic(camera: str) -> str:
    return f"/{camera}/image/compressed"


def depth_topic(camera: str) -> str:
    return f"/{camera}/depth/compressed"


def coding_of_depth(unit: float) -> str:
    """Return the ``format`` of a message with depth, whose 16-bit numbers are depths in ``unit`` [m]."""
    return f"16UC1; png; unit {unit:.6g} m"


def unit_of_depth(payload: bytes) -> float:
    """Return the unit [m] of the depth in a message. Raises :class:`ValueError` if its ``format`` has no unit."""
    coding = str(STORE.deserialize_cdr(payload, PICTURE).format)  # type: ignore[attr-defined]
    return float(coding.removeprefix("16UC1; png; unit ").removesuffix(" m"))


def heard_on(topic: str) -> str:
    """Return the topic to which the recorder subscribes in order to record ``topic``."""
    arm = topic.removeprefix("/q2r2/").split("/")[0]
    return asked_target(arm) if topic == target(arm) else topic


def is_compressed(topic: str) -> bool:
    """Return whether a camera's topic has CompressedImage messages, by the ending that image_transport gives it."""
    return topic.endswith("/compressed")


def is_latched(topic: str) -> bool:
    """Return whether later subscribers get the last message of a topic too."""
    return topic in (DESCRIPTION, "/tf_static") or topic.startswith("/cartesian_controller/following/")


def is_reliable(topic: Topic) -> bool:
    """Return whether the recorder requests reliable delivery from ROS, so that all messages of a topic arrive.

    For topics with commands and streams, the recorder does not request it, because their senders must not wait.
    """
    return topic.type in (ARRAY, TEXT) or topic.name == REFERENCE or heard_on(topic.name) != topic.name


class Message(NamedTuple):
    channel: int
    number: int  # The number of the message's tick, or the sequence number that the sender gave the message.
    time: int  # The Unix time of the message's receipt, or of the tick to which it belongs [ns].
    sent: int  # The Unix time at which the message was sent, by the sender's clock [ns].
    payload: bytes  # The message in CDR.

    @property
    def size(self) -> int:
        return len(self.payload)


class CodedPicture(NamedTuple):
    """A picture of a real camera. The writer makes a message from it."""

    channel: int
    number: int  # The number of the newest tick when the picture was captured.
    time: int  # The Unix time at which the picture was captured [ns].
    camera: str
    data: bytes
    coding: str = JPEG

    @property
    def size(self) -> int:
        return len(self.data)

    def message(self) -> Message:
        payload = picture(self.camera, self.time, self.data, self.coding)
        return Message(self.channel, self.number, self.time, self.time, payload)


class MessageTemplate:
    """Makes many messages that differ only in float64 numbers and in the stamp of the header.

    For one tick of two arms, it makes the messages with poses and joints in 3 us. rosbags needs 110 us. At 1 kHz, that
    is 11 % of a processor.
    """

    def __init__(self, kind: str, example: Any, count: int) -> None:
        """Make a template from the message ``example``, which contains the numbers 1, 2, ... ``count``.

        :meth:`filled` replaces the number k by column k - 1 of its argument.
        """
        payload = serialized(kind, example)
        self._size = len(payload)
        padding = bytes(-(len(payload) - _ENCAPSULATION) % 8)
        self._bytes = np.frombuffer(payload + padding, dtype=np.uint8)
        # CDR aligns a float64 to its size, counted from the end of the encapsulation.
        floats = self._bytes[_ENCAPSULATION:].view("<f8")
        self._places = [int(np.flatnonzero(floats == number)[0]) for number in range(1, count + 1)]

    def filled(self, numbers: Array, stamps: npt.NDArray[np.int64]) -> list[bytes]:
        """Return n messages in CDR, with ``numbers`` (n, count) and ``stamps`` (n,) [ns]."""
        made = np.tile(self._bytes, (len(numbers), 1))
        made[:, _ENCAPSULATION:].view("<f8")[:, self._places] = numbers
        stamp = made[:, _ENCAPSULATION : _ENCAPSULATION + 8].view("<u4")
        stamp[:, 0], stamp[:, 1] = stamps // NANOSECONDS, stamps % NANOSECONDS
        data, length = made.tobytes(), len(self._bytes)
        return [data[begin : begin + self._size] for begin in range(0, len(data), length)]


def make(kind: str, *values: Any) -> Any:
    return STORE.types[kind](*values)


def serialized(kind: str, message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, kind))


def header(frame: str = "", stamp: int = 0) -> Any:
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(stamp, NANOSECONDS)), frame)


def float_array(numbers: Array) -> Any:
    return make(ARRAY, make("std_msgs/msg/MultiArrayLayout", [], 0), np.asarray(numbers, dtype=np.float64))


def pose_stamped(pose: Array, frame: str = "", stamp: int = 0) -> Any:
    """Return a geometry_msgs/PoseStamped of a ``pose`` (7,) x y z [m] qx qy qz qw; ``stamp`` [ns]."""
    x, y, z, *quaternion = (float(number) for number in pose)
    point, rotation = make("geometry_msgs/msg/Point", x, y, z), make("geometry_msgs/msg/Quaternion", *quaternion)
    return make(POSE, header(frame, stamp), make("geometry_msgs/msg/Pose", point, rotation))


def pose_of(message: Any) -> Array:
    """Return the pose (7,) x y z [m] qx qy qz qw of a geometry_msgs/PoseStamped."""
    p, q = message.pose.position, message.pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def joint_state(names: list[str], position: Array, velocity: Array, effort: Array) -> Any:
    return make(JOINTS, header(), names, position, velocity, effort)


def measured(field: str, numbers: Array) -> Array:
    """Return the ``numbers`` of a JointState's ``field``. NaN becomes 0 if it only means that nothing is measured.

    The broadcaster of ros2_control writes NaN for numbers that the robot's hardware does not provide. If all velocities
    are NaN, they are not measured. If only some velocities are NaN, that is a fault, and the NaN stays.
    """
    missing = np.isnan(numbers)
    if field == "effort" or (field == "velocity" and missing.all()):
        return np.where(missing, 0.0, numbers)
    return numbers


def joint_trajectory(names: list[str], q: Array, v: Array, a: Array, stamp: int = 0) -> Any:
    """Return a trajectory_msgs/JointTrajectory with one point, which has to be reached at once; ``stamp`` [ns]."""
    at_once = make("builtin_interfaces/msg/Duration", 0, 0)
    point = make("trajectory_msgs/msg/JointTrajectoryPoint", q, v, a, np.empty(0), at_once)
    return make(TRAJECTORY, header(stamp=stamp), names, [point])


def array(numbers: Array) -> bytes:
    return serialized(ARRAY, float_array(numbers))


def text(data: str) -> bytes:
    return serialized(TEXT, make(TEXT, data))


def picture(camera: str, stamp: int, data: bytes, coding: str = JPEG) -> bytes:
    """Return a sensor_msgs/CompressedImage as CDR. Its ``frame_id`` is the name of the camera; ``stamp`` [ns]."""
    return serialized(PICTURE, make(PICTURE, header(camera, stamp), coding, np.frombuffer(data, dtype=np.uint8)))


def data_of(payload: bytes, kind: str) -> Any:
    """Return the field ``data`` of a message."""
    return STORE.deserialize_cdr(payload, kind).data  # type: ignore[attr-defined]


def numbers_of(payloads: list[bytes], count: int) -> Array:
    """Return the numbers (n, count) of n messages with arrays. Raises :class:`ValueError` for other lengths."""
    arrays = [data_of(payload, ARRAY) for payload in payloads]
    if any(len(array) != count for array in arrays):
        raise ValueError(f"an array that has not {count} numbers")
    return np.array(arrays, dtype=np.float64).reshape(-1, count)
