"""Frames of the ROS-TCP-Connector protocol, version 0.7: bytes in, frames out, and back. No sockets.

A frame is ``u32 n | n bytes destination | u32 m | m bytes payload``, little-endian, in both directions
(public source of Unity ROS-TCP-Connector 0.7.0).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from q2r2_control.errors import ProtocolError

MAX_FRAME_BYTES = 1 << 20  # a hand message has under 200; a longer frame means that the stream is out of step
KEEPALIVE = bytes(8)  # a frame without destination and payload

_LENGTH = struct.Struct("<I")


class WireFrame(NamedTuple):
    """One decoded frame; ``terminated`` tells whether the destination came with a trailing NUL."""

    destination: str
    payload: bytes
    terminated: bool

    @property
    def is_keepalive(self) -> bool:
        return not self.destination and not self.payload


def encode_frame(destination: str, payload: bytes) -> bytes:
    """The bytes of one frame from the server, whose destinations carry no NUL in either dialect."""
    name = destination.encode()
    return _LENGTH.pack(len(name)) + name + _LENGTH.pack(len(payload)) + payload


class FrameDecoder:
    """Cuts a byte stream into frames, however the network has split or joined them.

    Frames are taken one by one, so that whole frames before a fault are still used. Holds at most one frame of
    ``MAX_FRAME_BYTES`` and what :meth:`feed` was last given. After a :class:`ProtocolError` the stream has no known
    frame border any more and the decoder must be thrown away.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> None:
        """Append what the network delivered."""
        self._buffer += data

    def next_frame(self) -> WireFrame | None:
        """The next whole frame, or None until more bytes come.

        Raises :class:`ProtocolError` for a frame above ``MAX_FRAME_BYTES``, as soon as its length fields say so, and
        for a destination that is not UTF-8.
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
        return _frame(name, payload)

    def finish(self) -> None:
        """Tell the decoder that the stream has ended. Raises :class:`ProtocolError` when that was inside a frame."""
        if self._buffer:
            raise ProtocolError(f"stream ended inside a frame, {len(self._buffer)} bytes after its start")

    def _length_at(self, offset: int) -> int | None:
        if len(self._buffer) < offset + 4:
            return None
        (length,) = _LENGTH.unpack_from(self._buffer, offset)
        return int(length)


def _frame(name: bytes, payload: bytes) -> WireFrame:
    terminated = name.endswith(b"\0")
    try:
        destination = name.removesuffix(b"\0").decode()
    except UnicodeDecodeError:
        raise ProtocolError(f"destination {name[:40]!r} is not UTF-8") from None
    if not destination and payload:
        raise ProtocolError(f"{len(payload)} bytes of payload without a destination")
    return WireFrame(destination, payload, terminated)
