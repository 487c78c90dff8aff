"""The Quest2ROS app's messages in both dialects, (de)serialised by rosbags and checked more strictly than it does.

Strict checks distinguish the dialects: read with the wrong one, a pose is noise and a button stays pressed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields
from enum import StrEnum
from functools import cache
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from q2r2_control.errors import ProtocolError
from q2r2_control.types import Array, HandInputs, HapticFeedback


class Dialect(StrEnum):
    """How the app serialises: chosen in its settings, and visible in the bytes only."""

    ROS1 = "ROS1"
    ROS2 = "ROS2"

    @property
    def other(self) -> Dialect:
        return Dialect.ROS1 if self is Dialect.ROS2 else Dialect.ROS2


class MessageType(StrEnum):
    """Types by their two-part names on the wire."""

    POSE = "geometry_msgs/PoseStamped"
    TWIST = "geometry_msgs/Twist"
    INPUTS = "quest2ros/OVR2ROSInputs"
    HAPTIC = "quest2ros/OVR2ROSHapticFeedback"

    @property
    def full_name(self) -> str:
        """Three-part name, as ROS 2 and rosbags write it."""
        return self.value.replace("/", "/msg/")


@dataclass(frozen=True, slots=True)
class HandPose:
    """A hand's pose as sent: nothing is normalised, restamped or renamed. An identity rotation has w = -1."""

    position: Array  # (3,) [m]
    quaternion: Array  # (4,) x y z w
    stamp: float  # the headset's own clock [s]
    frame_id: str


@dataclass(frozen=True, slots=True)
class HandTwist:
    """A hand's velocity as sent."""

    linear: Array  # (3,) [m/s]
    angular: Array  # (3,) [rad/s]


HandMessage = HandPose | HandTwist | HandInputs

# quest2ros/msg/OVR2ROSInputs and OVR2ROSHapticFeedback of the public Quest2ROS repository.
_INPUTS_FIELDS = """
bool button_upper
bool button_lower
float32 thumb_stick_horizontal
float32 thumb_stick_vertical
float32 press_index
float32 press_middle
"""
_HAPTIC_FIELDS = """
float32 frequency
float32 amplitude
"""
_PLAIN_LITTLE_ENDIAN_CDR = b"\x00\x01\x00\x00"
_FIXED_SIZES = {
    (MessageType.TWIST, Dialect.ROS1): 48,
    (MessageType.TWIST, Dialect.ROS2): 52,
    (MessageType.INPUTS, Dialect.ROS1): 18,
    (MessageType.INPUTS, Dialect.ROS2): 24,
}
_EMPTY_FRAME_ID_LENGTH = {Dialect.ROS1: 0, Dialect.ROS2: 1}


def decode(kind: MessageType, payload: bytes, dialect: Dialect) -> HandMessage:
    """Read a pose, twist or inputs message.

    Numbers may be anything, NaN included; the bytes may not: a length, encapsulation, boolean or string that ``kind``
    does not have in ``dialect`` raises :class:`ProtocolError`.
    """
    _check_bytes(kind, payload, dialect)
    store = message_types(dialect)
    read = store.deserialize_ros1 if dialect is Dialect.ROS1 else store.deserialize_cdr
    try:
        message: Any = read(payload, kind.full_name)
    except SerdeError as error:
        raise ProtocolError(f"not a {dialect} {kind}: {error}") from error
    match kind:
        case MessageType.POSE:
            return _pose(message)
        case MessageType.TWIST:
            return HandTwist(_vector(message.linear), _vector(message.angular))
        case _:
            return HandInputs(**{field.name: getattr(message, field.name) for field in fields(HandInputs)})


def fits(kind: MessageType, payload: bytes, dialect: Dialect) -> bool:
    """Whether ``payload`` can be a message of ``kind`` in ``dialect``; never true of both dialects."""
    try:
        _check_bytes(kind, payload, dialect)
    except ProtocolError:
        return False
    return True


def encode(vibration: HapticFeedback, dialect: Dialect) -> bytes:
    """Serialise a vibration as two float32, frequency and amplitude."""
    store, name = message_types(dialect), MessageType.HAPTIC.full_name
    write = store.serialize_ros1 if dialect is Dialect.ROS1 else store.serialize_cdr
    return bytes(write(store.types[name](frequency=vibration.frequency, amplitude=vibration.amplitude), name))


def warm_up() -> None:
    """Compile every (de)serialiser now, about 0.5 s once a process, so that no first message waits for it."""
    for dialect in Dialect:
        for kind in MessageType:
            message_types(dialect).get_msgdef(kind.full_name)


@cache
def message_types(dialect: Dialect) -> Typestore:
    """The message types of ROS 1 Noetic or ROS 2 Jazzy, and those of quest2ros."""
    store = get_typestore(Stores.ROS1_NOETIC if dialect is Dialect.ROS1 else Stores.ROS2_JAZZY)
    for kind, text in ((MessageType.INPUTS, _INPUTS_FIELDS), (MessageType.HAPTIC, _HAPTIC_FIELDS)):
        store.register(get_types_from_msg(text, kind.full_name))
    return store


def _check_bytes(kind: MessageType, payload: bytes, dialect: Dialect) -> None:
    """Refuse what rosbags accepts: spare bytes, other encapsulations, strings without their NUL, booleans above 1."""
    expected = _expected_size(kind, payload, dialect)
    if len(payload) != expected:
        raise ProtocolError(f"a {dialect} {kind} has {expected} bytes here, got {len(payload)}")
    if dialect is Dialect.ROS2 and payload[:4] != _PLAIN_LITTLE_ENDIAN_CDR:
        raise ProtocolError(f"a {dialect} {kind} starts with 00 01 00 00, got {payload[:4].hex(' ')}")
    if kind is MessageType.POSE:
        _check_frame_id(payload, dialect)
    if kind is MessageType.INPUTS:
        start = 4 if dialect is Dialect.ROS2 else 0
        buttons = payload[start : start + 2]
        if max(buttons) > 1:
            raise ProtocolError(f"a button is 00 or 01, got {buttons.hex(' ')}")


def _expected_size(kind: MessageType, payload: bytes, dialect: Dialect) -> int:
    if kind is not MessageType.POSE:
        return _FIXED_SIZES[kind, dialect]
    length = _frame_id_length(payload) if len(payload) >= 16 else _EMPTY_FRAME_ID_LENGTH[dialect]
    if dialect is Dialect.ROS1:
        return 16 + length + 56
    return 4 + (12 + length + 7) // 8 * 8 + 56  # doubles are aligned to 8, counted from behind the encapsulation


def _frame_id_length(payload: bytes) -> int:
    """The length field of frame_id; offset 12 in both dialects, behind seq or the encapsulation, sec and nsec."""
    (length,) = struct.unpack_from("<I", payload, 12)
    return int(length)


def _check_frame_id(payload: bytes, dialect: Dialect) -> None:
    """With a frame_id of 4, 12, ... bytes a pose has the same size in both dialects: only the NUL tells them apart."""
    terminated = payload[16 : 16 + _frame_id_length(payload)].endswith(b"\0")
    if terminated != (dialect is Dialect.ROS2):
        raise ProtocolError(f"frame_id of a {dialect} pose ends {'with' if terminated else 'without'} NUL")


def _pose(message: Any) -> HandPose:
    orientation = message.pose.orientation
    stamp = message.header.stamp
    return HandPose(
        position=_vector(message.pose.position),
        quaternion=np.array([orientation.x, orientation.y, orientation.z, orientation.w]),
        stamp=stamp.sec + 1e-9 * stamp.nanosec,
        frame_id=message.header.frame_id,
    )


def _vector(message: Any) -> Array:
    return np.array([message.x, message.y, message.z])
