"""Messages of a fixed size as rows of numpy: the CDR of a ROS 2 message behind the head of its MCAP record.

A message type has one size where its names are known and its lists have fixed lengths, so a row is the whole record:
filling columns makes hundreds of messages with a few operations, and reading them back is ``np.frombuffer``. Layouts
follow the Object Management Group's CDR (XCDR1, little endian): a primitive is aligned to its own size, counted from
behind the four bytes of encapsulation; a string has a length, its text and a NUL; a sequence has a length.
The MCAP record is opcode, length, channel, sequence, log and publish time (https://mcap.dev/spec).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[np.void]

MESSAGE = 0x05  # opcode of a message's record
HEAD = struct.Struct("<BQHIQQ")  # of a message's record: opcode, length, channel, sequence, log time, publish time
_OPCODE_AND_LENGTH = 9
_ENCAPSULATION = b"\x00\x01\x00\x00"


class RowType:
    """Built field by field, in the order of the message's definition; then :attr:`dtype` and :meth:`rows`."""

    def __init__(self) -> None:
        self._fields: dict[str, tuple[str, int, int]] = {}  # name -> kind, count, offset
        self._constants: list[tuple[int, bytes]] = [(HEAD.size, _ENCAPSULATION)]
        self._begin = HEAD.size + len(_ENCAPSULATION)
        self._end = self._begin

    def field(self, name: str, kind: str, count: int = 1) -> RowType:
        """``count`` values of a numpy ``kind`` such as ``<f8``, which are filled in row by row."""
        self._fields[name] = (kind, count, self._take(np.dtype(kind).itemsize, count))
        return self

    def length(self, count: int) -> RowType:
        """The length of a sequence."""
        self._constants.append((self._take(4, 1), struct.pack("<I", count)))
        return self

    def text(self, text: str) -> RowType:
        """A string that is the same in all messages."""
        data = text.encode() + b"\0"
        self.length(len(data))
        self._constants.append((self._take(1, len(data)), data))
        return self

    def texts(self, texts: Sequence[str]) -> RowType:
        """A sequence of such strings."""
        self.length(len(texts))
        for text in texts:
            self.text(text)
        return self

    def numbers(self, name: str, count: int) -> RowType:
        """A sequence of ``count`` float64; of none where that is 0."""
        self.length(count)
        return self.field(name, "<f8", count) if count else self

    def header(self, frame: str = "") -> RowType:
        """A std_msgs/Header with fields ``sec`` and ``nanosec``."""
        return self.field("sec", "<i4").field("nanosec", "<u4").text(frame)

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Of one record, once all fields are known.

        Beside them it has ``channel``, ``sequence``, ``log_time`` and ``publish_time`` [ns].
        """
        head = {"channel": ("<u2", 9), "sequence": ("<u4", 11), "log_time": ("<u8", 15), "publish_time": ("<u8", 23)}
        names = [*head, *self._fields]
        formats: list[Any] = [kind for kind, _ in head.values()]
        formats += [kind if count == 1 else (kind, (count,)) for kind, count, _ in self._fields.values()]
        offsets = [offset for _, offset in head.values()] + [offset for _, _, offset in self._fields.values()]
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": self._end})

    def rows(self, channel: int, count: int) -> Rows:
        """``count`` messages of a ``channel``, all fields zero."""
        rows = np.frombuffer(bytearray(self._template * count), dtype=self.dtype)
        rows["channel"] = channel
        return rows

    @cached_property
    def _template(self) -> bytes:
        """A message of channel 0, all fields zero."""
        template = bytearray(self._end)
        template[: HEAD.size] = HEAD.pack(MESSAGE, self._end - _OPCODE_AND_LENGTH, 0, 0, 0, 0)
        for offset, data in self._constants:
            template[offset : offset + len(data)] = data
        return bytes(template)

    def _take(self, size: int, count: int) -> int:
        """Offset of ``count`` values of a ``size``, aligned."""
        offset = self._begin + -(-(self._end - self._begin) // size) * size
        self._end = offset + size * count
        return offset


def message_record(channel: int, sequence: int, log_time: int, publish_time: int, payload: bytes) -> bytes:
    """The record of a message that is serialized already; times [ns]."""
    length = HEAD.size - _OPCODE_AND_LENGTH + len(payload)
    return HEAD.pack(MESSAGE, length, channel, sequence, log_time, publish_time) + payload


def text_record(channel: int, sequence: int, log_time: int, text: str) -> bytes:
    """The record of a std_msgs/String."""
    data = text.encode() + b"\0"
    payload = _ENCAPSULATION + struct.pack("<I", len(data)) + data
    return message_record(channel, sequence, log_time, log_time, payload)


def text_of(record: bytes) -> str:
    """The text of such a record."""
    return record[HEAD.size + len(_ENCAPSULATION) + 4 : -1].decode()


_PICTURE_FORMAT = b"jpeg\0"


def picture_record(channel: int, sequence: int, log_time: int, camera: str, jpeg: bytes) -> bytes:
    """The record of a sensor_msgs/CompressedImage of a camera, which is its frame too."""
    frame = camera.encode() + b"\0"
    head = struct.pack("<iII", *divmod(log_time, 1_000_000_000), len(frame)) + frame
    head += bytes(-len(head) % 4) + struct.pack("<I", len(_PICTURE_FORMAT)) + _PICTURE_FORMAT
    head += bytes(-len(head) % 4) + struct.pack("<I", len(jpeg))
    length = HEAD.size - _OPCODE_AND_LENGTH + len(_ENCAPSULATION) + len(head) + len(jpeg)
    begin = HEAD.pack(MESSAGE, length, channel, sequence, log_time, log_time)
    return b"".join((begin, _ENCAPSULATION, head, jpeg))


def jpeg_of(record: bytes) -> bytes:
    """The picture in such a record. Raises :class:`ValueError` and :class:`struct.error` for another."""
    begin = HEAD.size + len(_ENCAPSULATION)
    at = 8
    for _ in range(2):  # frame and format
        (length,) = struct.unpack_from("<I", record, begin + at)
        at += 4 + length
        at += -at % 4
    (length,) = struct.unpack_from("<I", record, begin + at)
    first = begin + at + 4
    # Middlewares fill a message up to a multiple of four bytes.
    if not first + length <= len(record) < first + length + 4:
        raise ValueError("a picture of another size than it says")
    return record[first : first + length]


def at_time(record: bytes, log_time: int) -> bytes:
    """The same message with other times [ns]."""
    opcode, length, channel, sequence, _, _ = HEAD.unpack_from(record)
    return HEAD.pack(opcode, length, channel, sequence, log_time, log_time) + record[HEAD.size :]


def channel_of(record: bytes) -> int:
    """Of a message's record."""
    return int(HEAD.unpack_from(record)[2])


def pose_stamped(frame: str) -> RowType:
    """geometry_msgs/PoseStamped with fields ``position`` and ``quaternion``, x y z w."""
    return RowType().header(frame).field("position", "<f8", 3).field("quaternion", "<f8", 4)


def joint_state(names: Sequence[str], *lists: str) -> RowType:
    """sensor_msgs/JointState that has those of its ``lists`` position, velocity and effort."""
    row = RowType().header().texts(names)
    for name in ("position", "velocity", "effort"):
        row.numbers(name, len(names) if name in lists else 0)
    return row


def joint_trajectory(names: Sequence[str]) -> RowType:
    """trajectory_msgs/JointTrajectory of one point with positions, velocities and accelerations, due at once."""
    row = RowType().header().texts(names).length(1)
    for name in ("positions", "velocities", "accelerations"):
        row.numbers(name, len(names))
    return row.numbers("effort", 0).field("time_from_start_sec", "<i4").field("time_from_start_nanosec", "<u4")


def float_array(count: int) -> RowType:
    """std_msgs/Float64MultiArray without dimensions, with the field ``data``."""
    return RowType().length(0).length(0).numbers("data", count)


def hand_inputs() -> RowType:
    """quest2ros/OVR2ROSInputs."""
    row = RowType().field("button_upper", "u1").field("button_lower", "u1")
    for name in ("thumb_stick_horizontal", "thumb_stick_vertical", "press_index", "press_middle"):
        row.field(name, "<f4")
    return row


def log_time(record: bytes) -> int:
    """Of a message's record [ns]."""
    return int(HEAD.unpack_from(record)[4])


def sequence_of(record: bytes) -> int:
    """The number of a message's record."""
    return int(HEAD.unpack_from(record)[3])
