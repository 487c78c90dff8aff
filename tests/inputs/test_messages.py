"""Frames and messages are read from bytes that are written by hand here. Bytes that are no message are refused."""

from __future__ import annotations

import math
import random
import struct

import numpy as np
import pytest

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.messages import (
    KEEPALIVE,
    MAX_FRAME_BYTES,
    Dialect,
    FrameDecoder,
    HandPose,
    HandTwist,
    MessageType,
    WireFrame,
    decode,
    encode_frame,
    fits,
)
from q2r2_control.types import HandInputs

ROS1, ROS2 = Dialect.ROS1, Dialect.ROS2

# Little-endian IEEE 754 numbers: first doubles (1.0 is 3FF0..., 2.0 is 4000...), then floats, whose names end with _F.
ONE, TWO, MINUS_ONE, HALF, ZERO = (
    bytes.fromhex(text)
    for text in ("000000000000f03f", "0000000000000040", "000000000000f0bf", "000000000000e03f", "0000000000000000")
)
ONE_F, MINUS_ONE_F, HALF_F, ZERO_F = (bytes.fromhex(text) for text in ("0000803f", "000080bf", "0000003f", "00000000"))
CDR = bytes.fromhex("00010000")
STAMP = bytes.fromhex("0c000000 0065cd1d")  # The stamp is 12 s and 500,000,000 ns.
# Position 1 2 0.5, and the identity rotation as the app sends it, with w = -1.
NUMBERS = ONE + TWO + HALF + ZERO + ZERO + ZERO + MINUS_ONE

POSES = {
    ROS1: bytes.fromhex("07000000") + STAMP + bytes.fromhex("00000000") + NUMBERS,
    ROS2: CDR + STAMP + bytes.fromhex("01000000 00 000000") + NUMBERS,
}
TWISTS = {ROS1: ONE + TWO + HALF + ZERO + ZERO + MINUS_ONE, ROS2: CDR + ONE + TWO + HALF + ZERO + ZERO + MINUS_ONE}
INPUTS = {
    ROS1: bytes.fromhex("0100") + ONE_F + MINUS_ONE_F + HALF_F + ZERO_F,
    ROS2: CDR + bytes.fromhex("0100 0000") + ONE_F + MINUS_ONE_F + HALF_F + ZERO_F,
}
PAYLOADS = {MessageType.POSE: POSES, MessageType.TWIST: TWISTS, MessageType.INPUTS: INPUTS}

every_dialect = pytest.mark.parametrize("dialect", list(Dialect))
every_kind = pytest.mark.parametrize("kind", list(PAYLOADS))


def pose_with_frame(dialect: Dialect, frame_id: bytes) -> bytes:
    """Return the bytes of a pose whose ``frame_id`` has these bytes. In the dialect ROS2 they have to end with NUL."""
    length = len(frame_id).to_bytes(4, "little")
    if dialect is ROS1:
        # The first four bytes are the sequence number 256, which looks like the encapsulation of a ROS2 message.
        return bytes.fromhex("00010000") + STAMP + length + frame_id + NUMBERS
    text = STAMP + length + frame_id
    return CDR + text + b"\xaa" * (-len(text) % 8) + NUMBERS


@every_dialect
def test_messages_are_read_as_they_were_sent_including_the_stamp_and_a_quaternion_with_w_minus_one(
    dialect: Dialect,
) -> None:
    pose, twist, inputs = (decode(kind, payload[dialect], dialect) for kind, payload in PAYLOADS.items())
    assert isinstance(pose, HandPose)
    assert isinstance(twist, HandTwist)
    assert (pose.position.tolist(), pose.quaternion.tolist()) == ([1.0, 2.0, 0.5], [0.0, 0.0, 0.0, -1.0])
    assert (pose.stamp, pose.frame_id) == (12.5, "")
    assert (twist.linear.tolist(), twist.angular.tolist()) == ([1.0, 2.0, 0.5], [0.0, 0.0, -1.0])
    assert inputs == HandInputs(
        button_upper=True, thumb_stick_horizontal=1.0, thumb_stick_vertical=-1.0, press_index=0.5
    )


@every_dialect
@pytest.mark.parametrize("name", ["map", "träume"])
def test_a_pose_after_a_frame_id_of_any_length_is_read_and_the_frame_id_is_kept(dialect: Dialect, name: str) -> None:
    wire_name = name.encode() + (b"\0" if dialect is ROS2 else b"")
    pose = decode(MessageType.POSE, pose_with_frame(dialect, wire_name), dialect)
    assert isinstance(pose, HandPose)
    assert pose.frame_id == name
    assert pose.position.tolist() == [1.0, 2.0, 0.5]
    assert pose.quaternion.tolist() == [0.0, 0.0, 0.0, -1.0]


def test_no_payload_fits_both_dialects_and_poses_of_equal_size_differ_by_the_nul_of_frame_id() -> None:
    equal = {ROS1: pose_with_frame(ROS1, b"room"), ROS2: pose_with_frame(ROS2, b"map\0")}
    assert len(equal[ROS1]) == len(equal[ROS2])
    for kind, payloads in (*PAYLOADS.items(), (MessageType.POSE, equal)):
        for dialect, payload in payloads.items():
            assert fits(kind, payload, dialect)
            assert not fits(kind, payload, dialect.other)
            with pytest.raises(ProtocolError):
                decode(kind, payload, dialect.other)


@every_dialect
@every_kind
def test_a_payload_of_a_wrong_length_is_refused(kind: MessageType, dialect: Dialect) -> None:
    payload = PAYLOADS[kind][dialect]
    for wrong in (*(payload[:length] for length in range(len(payload))), payload + b"\0", payload + bytes(8)):
        with pytest.raises(ProtocolError, match="bytes"):
            decode(kind, wrong, dialect)


@every_kind
@pytest.mark.parametrize("encapsulation", ["00000000", "00010001"])
def test_encapsulations_other_than_plain_little_endian_are_refused(kind: MessageType, encapsulation: str) -> None:
    with pytest.raises(ProtocolError):
        decode(kind, bytes.fromhex(encapsulation) + PAYLOADS[kind][ROS2][4:], ROS2)


@every_dialect
@pytest.mark.parametrize("button", [0, 1])
def test_a_button_that_is_neither_0_nor_1_is_refused(dialect: Dialect, button: int) -> None:
    payload = bytearray(INPUTS[dialect])
    payload[(4 if dialect is ROS2 else 0) + button] = 2
    with pytest.raises(ProtocolError, match="button"):
        decode(MessageType.INPUTS, bytes(payload), dialect)


@every_dialect
def test_a_frame_id_with_a_wrong_length_or_without_utf8_is_refused(dialect: Dialect) -> None:
    lies = [POSES[dialect][:12] + struct.pack("<I", length) + POSES[dialect][16:] for length in (9, 0xFFFFFFFF)]
    for payload in (*lies, pose_with_frame(dialect, b"\xff\xfe" + (b"\0" if dialect is ROS2 else b""))):
        with pytest.raises(ProtocolError):
            decode(MessageType.POSE, payload, dialect)


@every_dialect
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_read_so_that_the_teleop_layer_rejects_them(
    dialect: Dialect, value: float
) -> None:
    payload = POSES[dialect][:-56] + struct.pack("<7d", *[value] * 7)
    pose = decode(MessageType.POSE, payload, dialect)
    assert isinstance(pose, HandPose)
    np.testing.assert_equal(pose.position, [value] * 3)
    np.testing.assert_equal(pose.quaternion, [value] * 4)


def test_random_and_mutated_bytes_raise_only_protocol_errors() -> None:
    random_source = random.Random(7)
    refused = 0
    for _ in range(3000):
        kind = random_source.choice(list(PAYLOADS))
        dialect = random_source.choice(list(Dialect))
        payload = bytearray(PAYLOADS[kind][random_source.choice(list(Dialect))])
        for _ in range(random_source.randrange(4)):
            payload[random_source.randrange(len(payload))] = random_source.randrange(256)
        if random_source.random() < 0.3:
            payload = bytearray(random_source.randbytes(random_source.randrange(120)))
        try:
            decode(kind, bytes(payload), dialect)
        except ProtocolError:
            refused += 1
    assert 1800 < refused < 2400


# A frame by the protocol: length 4, "/abc", length 3, "xyz".
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


def test_a_frame_has_the_bytes_of_the_protocol_and_only_one_nul_is_removed_from_its_destination() -> None:
    assert encode_frame("/abc", b"xyz") == ABC
    assert frames(ABC) == [WireFrame("/abc", b"xyz", terminated=False)]
    assert frames(KEEPALIVE) == [WireFrame("", b"", terminated=False)]
    assert frames(b"\x05\x00\x00\x00abc\x00\x00\x00\x00\x00\x00") == [WireFrame("abc\0", b"", terminated=True)]


def test_a_stream_split_at_any_byte_gives_the_same_frames() -> None:
    stream = ABC_NUL + KEEPALIVE + ABC
    whole = frames(stream)
    assert [frame.terminated for frame in whole] == [True, False, False]
    assert frames(*(bytes([byte]) for byte in stream)) == whole
    for split in range(1, len(stream)):
        assert frames(stream[:split], stream[split:]) == whole


def test_a_frame_of_exactly_one_mebibyte_is_allowed() -> None:
    (frame,) = frames(encode_frame("big", bytes(MAX_FRAME_BYTES - 8 - 3)))
    assert len(frame.payload) == MAX_FRAME_BYTES - 11


TOO_LONG = "bytes announced, at most 1048576 are allowed"


@pytest.mark.parametrize(
    ("stream", "reason"),
    [
        (ABC[:1], "ended inside a frame, 1 bytes"),
        (ABC[:-1], f"ended inside a frame, {len(ABC) - 1} bytes"),
        pytest.param(struct.pack("<I", MAX_FRAME_BYTES - 7), TOO_LONG, id="destination without room for lengths"),
        pytest.param(struct.pack("<I3sI", 3, b"big", MAX_FRAME_BYTES - 10), TOO_LONG, id="payload one byte too long"),
        pytest.param(b"GET / HTTP/1.1\r\n\r\n", TOO_LONG, id="another protocol"),
        (b"\x02\x00\x00\x00\xff\xfe\x00\x00\x00\x00", "not UTF-8"),
        (b"\x00\x00\x00\x00\x01\x00\x00\x00x", "without a destination"),
    ],
)
def test_bytes_that_cannot_be_a_frame_are_refused_with_a_reason(stream: bytes, reason: str) -> None:
    with pytest.raises(ProtocolError, match=reason):
        frames(stream)


def test_frames_before_invalid_bytes_are_still_read() -> None:
    decoder = FrameDecoder()
    decoder.feed(ABC + b"\xff\xff\xff\xff")
    assert decoder.next_frame() == WireFrame("/abc", b"xyz", terminated=False)
    with pytest.raises(ProtocolError):
        decoder.next_frame()
