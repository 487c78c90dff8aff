"""Read and write the data of the Quest2ROS app: frames of ROS-TCP-Connector 0.7, and the messages in them.

This module uses no sockets. A frame is ``u32 n | n bytes destination | u32 m | m bytes payload``, little-endian, in
both directions (public source of Unity ROS-TCP-Connector 0.7.0). The package rosbags (de)serialises the messages. This
module checks them more strictly than rosbags, to distinguish the dialects. In the wrong dialect, a pose would be read
as meaningless numbers, and a button would seem to stay pressed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from q2r2_control.errors import ProtocolError
from q2r2_control.extras import importing
from q2r2_control.types import QUEST_CONTROLS, Array, HandInputs, HapticFeedback

with importing("headset", "the format of hand messages"):
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore


class Dialect(StrEnum):
    """The app's form of serialisation. The app's user sets it, and the server sees it only from the messages' bytes."""

    ROS1 = "ROS1"
    ROS2 = "ROS2"

    @property
    def other(self) -> Dialect:
        return Dialect.ROS1 if self is Dialect.ROS2 else Dialect.ROS2


class MessageType(StrEnum):
    """Message types, by their two-part names in the app's frames."""

    POSE = "geometry_msgs/PoseStamped"
    TWIST = "geometry_msgs/Twist"
    INPUTS = "quest2ros/OVR2ROSInputs"
    HAPTIC = "quest2ros/OVR2ROSHapticFeedback"

    @property
    def full_name(self) -> str:
        """The name in three parts, as ROS 2 and rosbags write it."""
        return self.value.replace("/", "/msg/")


@dataclass(frozen=True, slots=True)
class HandPose:
    """A hand's pose as it was sent: nothing is normalised, restamped or renamed.

    For the identity rotation, the app sends w = -1.
    """

    position: Array  # (3,) [m]
    quaternion: Array  # (4,) x y z w
    stamp: float  # Time on the headset's own clock [s].
    frame_id: str


@dataclass(frozen=True, slots=True)
class HandTwist:
    """A hand's velocity as it was sent."""

    linear: Array  # (3,) [m/s]
    angular: Array  # (3,) [rad/s]


HandMessage = HandPose | HandTwist | HandInputs

# The messages OVR2ROSInputs and OVR2ROSHapticFeedback of quest2ros/msg in the public Quest2ROS repository.
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


def decode(kind: MessageType, payload: bytes, dialect: Dialect) -> HandMessage:
    """Read a message: a pose, a twist, or the inputs of a hand. Its numbers may have any value, also NaN.

    Raises:
        ProtocolError: If a length, an encapsulation, a boolean or a string is impossible in a message of ``kind`` in
            ``dialect``.
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
            stamp, orientation = message.header.stamp, message.pose.orientation
            quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
            sent = stamp.sec + 1e-9 * stamp.nanosec
            return HandPose(_vector(message.pose.position), quaternion, sent, message.header.frame_id)
        case MessageType.TWIST:
            return HandTwist(_vector(message.linear), _vector(message.angular))
        case _:
            return HandInputs(**{name: getattr(message, name) for name in QUEST_CONTROLS.names})


def fits(kind: MessageType, payload: bytes, dialect: Dialect) -> bool:
    """Return whether ``payload`` can be a message of ``kind`` in ``dialect``. No payload fits both dialects."""
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
    """Compile every (de)serialiser now, so that the first message need not wait. This takes about 0.5 s per process."""
    for dialect in Dialect:
        for kind in MessageType:
            message_types(dialect).get_msgdef(kind.full_name)


@cache
def message_types(dialect: Dialect) -> Typestore:
    """Return the message types of ROS 1 Noetic or ROS 2 Jazzy, together with the message types of quest2ros."""
    store = get_typestore(Stores.ROS1_NOETIC if dialect is Dialect.ROS1 else Stores.ROS2_JAZZY)
    for kind, text in ((MessageType.INPUTS, _INPUTS_FIELDS), (MessageType.HAPTIC, _HAPTIC_FIELDS)):
        store.register(get_types_from_msg(text, kind.full_name))
    return store


def _check_bytes(kind: MessageType, payload: bytes, dialect: Dialect) -> None:
    """Raise ProtocolError for wrong bytes that rosbags would accept.

    Such bytes are spare bytes, other encapsulations, strings without their NUL, and booleans above 1.
    """
    ros2 = dialect is Dialect.ROS2
    length = int.from_bytes(payload[12:16], "little")  # Length of a pose's frame_id, in both dialects.
    if kind is not MessageType.POSE:
        expected = _FIXED_SIZES[kind, dialect]
    elif ros2:
        expected = 4 + (12 + length + 7) // 8 * 8 + 56  # Doubles are aligned to 8 bytes after the encapsulation.
    else:
        expected = 16 + length + 56
    if len(payload) != expected:
        raise ProtocolError(f"a {dialect} {kind} has {expected} bytes here, got {len(payload)}")
    if ros2 and payload[:4] != _PLAIN_LITTLE_ENDIAN_CDR:
        raise ProtocolError(f"a {dialect} {kind} starts with 00 01 00 00, got {payload[:4].hex(' ')}")
    # If the frame_id has 4, 12, ... bytes, a pose has the same size in both dialects. Only the NUL tells them apart.
    if kind is MessageType.POSE and payload[16 : 16 + length].endswith(b"\0") is not ros2:
        raise ProtocolError(f"frame_id of a {dialect} pose ends {'without' if ros2 else 'with'} NUL")
    buttons = payload[4:6] if ros2 else payload[:2]
    if kind is MessageType.INPUTS and max(buttons) > 1:
        raise ProtocolError(f"a button is 00 or 01, got {buttons.hex(' ')}")


def _vector(message: Any) -> Array:
    return np.array([message.x, message.y, message.z])


# A hand message has under 200 bytes. If a frame seems longer than this, the stream was read from a wrong position.
MAX_FRAME_BYTES = 1 << 20
KEEPALIVE = bytes(8)  # A frame without destination and payload.


class WireFrame(NamedTuple):
    """One frame of the stream."""

    destination: str
    payload: bytes
    terminated: bool  # Whether the destination came with a trailing NUL.


def encode_frame(destination: str, payload: bytes) -> bytes:
    """Return the bytes of one frame that the server sends. Its destination ends without NUL in both dialects."""
    name = destination.encode()
    return len(name).to_bytes(4, "little") + name + len(payload).to_bytes(4, "little") + payload


class FrameDecoder:
    """Cuts a byte stream into frames, however the network has split or joined them.

    Frames are taken one by one, so that whole frames before a fault are still used. The decoder holds at most one frame
    of ``MAX_FRAME_BYTES`` and the last data of :meth:`feed`. After a :class:`ProtocolError` it must not be used again.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> None:
        self._buffer += data

    def next_frame(self) -> WireFrame | None:
        """Return the next whole frame, or None until more bytes come.

        Raises:
            ProtocolError: For a frame above ``MAX_FRAME_BYTES``, as soon as its length fields say so. Also for a
                destination that is not UTF-8, and for a payload without a destination.
        """
        name_size = self._length_at(0)
        if name_size is None:
            return None
        payload_size = self._length_at(4 + name_size)
        size = 8 + name_size + (payload_size or 0)
        if size > MAX_FRAME_BYTES:
            raise ProtocolError(f"frame of {size} bytes announced, at most {MAX_FRAME_BYTES} are allowed")
        if payload_size is None or len(self._buffer) < size:
            return None
        name = bytes(self._buffer[4 : 4 + name_size])
        payload = bytes(self._buffer[8 + name_size : size])
        del self._buffer[:size]
        try:
            destination = name.removesuffix(b"\0").decode()
        except UnicodeDecodeError:
            raise ProtocolError(f"destination {name[:40]!r} is not UTF-8") from None
        if not destination and payload:
            raise ProtocolError(f"{len(payload)} bytes of payload without a destination")
        return WireFrame(destination, payload, terminated=name.endswith(b"\0"))

    def finish(self) -> None:
        """Note that the stream has ended. Raises :class:`ProtocolError` if it has ended inside a frame."""
        if self._buffer:
            raise ProtocolError(f"stream ended inside a frame, {len(self._buffer)} bytes after its start")

    def _length_at(self, offset: int) -> int | None:
        field = self._buffer[offset : offset + 4]
        return int.from_bytes(field, "little") if len(field) == 4 else None
