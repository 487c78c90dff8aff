"""The messages of a recording: ROS 2 messages in CDR, which rosbags writes and reads."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from q2r2_control.inputs.messages import Dialect, message_types
from q2r2_control.types import Array

STORE = message_types(Dialect.ROS2)
ARRAY, TEXT, PICTURE = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "sensor_msgs/msg/CompressedImage"
POSE, JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"
TRAJECTORY, HAND_INPUTS = "trajectory_msgs/msg/JointTrajectory", "quest2ros/msg/OVR2ROSInputs"
NANOSECONDS = 1_000_000_000
_ENCAPSULATION = 4  # bytes before the message
_ARRAY_HEAD = 20  # bytes before the numbers of an array


class Message(NamedTuple):
    """One message of a file."""

    channel: int
    number: int  # of its tick, or at its sender
    time: int  # of day [ns]
    sent: int  # of day, by its sender's clock [ns]
    payload: bytes  # CDR


class MessageTemplate:
    """Makes many messages that differ in float64 numbers, and where they have a header in its stamp."""

    def __init__(self, kind: str, example: Any, count: int) -> None:
        """``example``: a message whose numbers are 1, 2, ... ``count`` in the order in which they will be given."""
        payload = serialized(kind, example)
        self._size, self._stamped = len(payload), hasattr(example, "header")
        padding = bytes(-(len(payload) - _ENCAPSULATION) % 8)
        self._bytes = np.frombuffer(payload + padding, dtype=np.uint8)
        # CDR aligns a float64 to its size, counted from behind the encapsulation.
        floats = self._bytes[_ENCAPSULATION:].view("<f8")
        self._places = [int(np.flatnonzero(floats == number)[0]) for number in range(1, count + 1)]

    def filled(self, numbers: Array, stamps: npt.NDArray[np.int64]) -> list[bytes]:
        """n messages with ``numbers`` (n, count), and ``stamps`` (n,) [ns] where they have a header."""
        made = np.tile(self._bytes, (len(numbers), 1))
        made[:, _ENCAPSULATION:].view("<f8")[:, self._places] = numbers
        if self._stamped:
            stamp = made[:, _ENCAPSULATION : _ENCAPSULATION + 8].view("<u4")
            stamp[:, 0], stamp[:, 1] = stamps // NANOSECONDS, stamps % NANOSECONDS
        data, length = made.tobytes(), len(self._bytes)
        return [data[begin : begin + self._size] for begin in range(0, len(data), length)]


def make(kind: str, *values: Any) -> Any:
    """A message, of the values of its fields in their order."""
    return STORE.types[kind](*values)


def serialized(kind: str, message: Any) -> bytes:
    """A message as CDR."""
    return bytes(STORE.serialize_cdr(message, kind))


def header(frame: str = "", stamp: int = 0) -> Any:
    """A std_msgs/Header; ``stamp`` [ns]."""
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(stamp, NANOSECONDS)), frame)


def float_array(numbers: Array) -> Any:
    """A std_msgs/Float64MultiArray without dimensions."""
    return make(ARRAY, make("std_msgs/msg/MultiArrayLayout", [], 0), np.asarray(numbers, dtype=np.float64))


def pose_stamped(pose: Array, frame: str = "", stamp: int = 0) -> Any:
    """A geometry_msgs/PoseStamped of x y z qx qy qz qw."""
    x, y, z, *quaternion = (float(number) for number in pose)
    point, rotation = make("geometry_msgs/msg/Point", x, y, z), make("geometry_msgs/msg/Quaternion", *quaternion)
    return make(POSE, header(frame, stamp), make("geometry_msgs/msg/Pose", point, rotation))


def pose_of(message: Any) -> Array:
    """(7,) x y z [m] qx qy qz qw of such a message."""
    p, q = message.pose.position, message.pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def joint_state(names: list[str], position: Array, velocity: Array, effort: Array) -> Any:
    """A sensor_msgs/JointState."""
    return make(JOINTS, header(), names, position, velocity, effort)


def joint_trajectory(names: list[str], q: Array, v: Array, a: Array, stamp: int = 0) -> Any:
    """A trajectory_msgs/JointTrajectory of one point that is due at once."""
    at_once = make("builtin_interfaces/msg/Duration", 0, 0)
    point = make("trajectory_msgs/msg/JointTrajectoryPoint", q, v, a, np.empty(0), at_once)
    return make(TRAJECTORY, header(stamp=stamp), names, [point])


def text(data: str) -> bytes:
    """A std_msgs/String as CDR."""
    return serialized(TEXT, make(TEXT, data))


def text_of(payload: bytes) -> str:
    """The text of such a message."""
    return str(STORE.deserialize_cdr(payload, TEXT).data)  # type: ignore[attr-defined]


def picture(camera: str, stamp: int, jpeg: bytes) -> bytes:
    """A sensor_msgs/CompressedImage of a camera, which is its frame too, as CDR; ``stamp`` [ns]."""
    return serialized(PICTURE, make(PICTURE, header(camera, stamp), "jpeg", np.frombuffer(jpeg, dtype=np.uint8)))


def jpeg_of(payload: bytes) -> bytes:
    """The picture in such a message."""
    return bytes(STORE.deserialize_cdr(payload, PICTURE).data)  # type: ignore[attr-defined]


def numbers_of(payloads: list[bytes], count: int) -> Array:
    """(n, count) of n arrays without dimensions. Raises :class:`ValueError` for arrays of another length."""
    if any(len(payload) != _ARRAY_HEAD + 8 * count for payload in payloads):
        raise ValueError(f"an array that has not {count} numbers")
    return np.frombuffer(b"".join(payload[_ARRAY_HEAD:] for payload in payloads)).reshape(-1, count)
