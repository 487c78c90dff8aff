"""Frames are cut out of the stream however it arrives, and what cannot be a frame is refused with its reason."""

from __future__ import annotations

import struct

import pytest

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.messages import KEEPALIVE, MAX_FRAME_BYTES, FrameDecoder, WireFrame, encode_frame

# Written by hand from the protocol: length 4, "/abc", length 3, "xyz".
ABC = b"\x04\x00\x00\x00/abc\x03\x00\x00\x00xyz"
ABC_NUL = b"\x05\x00\x00\x00/abc\x00\x03\x00\x00\x00xyz"


def frames(*chunks: bytes) -> list[WireFrame]:
    decoder = FrameDecoder()
    found = []
    for chunk in chunks:
        decoder.feed(chunk)
        while (frame := decoder.next_frame()) is not None:
            found.append(frame)
    decoder.finish()
    return found


def test_a_frame_is_read_and_written_as_by_hand_and_the_server_writes_no_nul() -> None:
    assert encode_frame("/abc", b"xyz") == ABC
    assert frames(ABC) == [WireFrame("/abc", b"xyz", terminated=False)]


def test_only_one_nul_is_taken_off() -> None:
    assert frames(b"\x05\x00\x00\x00abc\x00\x00\x00\x00\x00\x00") == [WireFrame("abc\0", b"", terminated=True)]


def test_a_stream_split_at_any_byte_gives_the_same_frames() -> None:
    stream = ABC_NUL + KEEPALIVE + ABC
    whole = frames(stream)
    assert [frame.terminated for frame in whole] == [True, False, False]
    assert frames(*(bytes([byte]) for byte in stream)) == whole
    for split in range(1, len(stream)):
        assert frames(stream[:split], stream[split:]) == whole


@pytest.mark.parametrize("length", [1, len(ABC) - 1])
def test_a_stream_that_ends_inside_a_frame_is_truncated(length: int) -> None:
    with pytest.raises(ProtocolError, match=f"ended inside a frame, {length} bytes"):
        frames(ABC[:length])


def test_a_frame_of_exactly_one_mebibyte_is_allowed() -> None:
    (frame,) = frames(encode_frame("big", bytes(MAX_FRAME_BYTES - 8 - 3)))
    assert len(frame.payload) == MAX_FRAME_BYTES - 11


@pytest.mark.parametrize(
    "announcement",
    [
        pytest.param(struct.pack("<I", MAX_FRAME_BYTES - 7), id="destination that leaves no room for lengths"),
        pytest.param(struct.pack("<I3sI", 3, b"big", MAX_FRAME_BYTES - 10), id="payload one byte too long"),
        pytest.param(b"GET / HTTP/1.1\r\n\r\n", id="another protocol"),
    ],
)
def test_an_oversized_frame_is_refused_when_it_is_announced(announcement: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"bytes announced, at most 1048576 are allowed"):
        frames(announcement)


def test_a_destination_that_is_not_utf8_is_refused() -> None:
    with pytest.raises(ProtocolError, match="not UTF-8"):
        frames(b"\x02\x00\x00\x00\xff\xfe\x00\x00\x00\x00")


def test_payload_without_destination_is_refused() -> None:
    with pytest.raises(ProtocolError, match="without a destination"):
        frames(b"\x00\x00\x00\x00\x01\x00\x00\x00x")


def test_frames_before_a_fault_are_not_lost() -> None:
    decoder = FrameDecoder()
    decoder.feed(ABC + b"\xff\xff\xff\xff")
    assert decoder.next_frame() == WireFrame("/abc", b"xyz", terminated=False)
    with pytest.raises(ProtocolError):
        decoder.next_frame()
