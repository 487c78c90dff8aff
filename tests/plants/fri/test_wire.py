from __future__ import annotations

import contextlib
import dataclasses
import struct
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.errors import ProtocolError
from q2r2_control.plants.fri.schema import MonitoringMessage
from q2r2_control.plants.fri.wire import (
    CommandKind,
    Drives,
    FriCommand,
    Monitoring,
    Operation,
    Quality,
    Safety,
    Session,
    read_command,
    read_monitoring,
    version_of,
    write_command,
    write_monitoring,
)

Q = (0.1, -0.2, 0.3, -1.4, 0.5, 1.6, -0.7)
MONITORING = Monitoring(
    version=2,
    counter=7,
    reflected=5,
    session=Session.COMMANDING_ACTIVE,
    quality=Quality.EXCELLENT,
    period=0.005,
    multiplier=2,
    q=Q,
    stamp=1234.25,
    tau=tuple(10.0 * value for value in Q),
    external_tau=Q,
    commanded_q=Q,
    ipo_q=Q,
    command=CommandKind.TORQUE,
    safety=Safety.STOP_2,
    operation=Operation.T1,
    drives=Drives.TRANSITIONING,
    io={"gripper_open": True, "width": 0.25, "status": 3},
    outputs=frozenset({"gripper_open"}),
    commanded_tau=tuple(11.0 * value for value in Q),
)


def _field(number: int, wire_type: int, payload: bytes) -> bytes:
    return bytes([number << 3 | wire_type]) + payload


def _inner(number: int, payload: bytes) -> bytes:
    return _field(number, 2, bytes([len(payload)]) + payload)


def _double(value: float) -> bytes:
    return struct.pack("<d", value)


# The bytes are written by hand from the published field numbers: header, joints one by one, session 4, quality 3, 5 ms.
HEADER = _inner(1, b"\x08\xc2\xa2\x91\x01" + b"\x10\x07" + b"\x18\x05")
JOINTS = b"".join(_field(1, 1, _double(value)) for value in Q)
CONNECTION = _inner(4, b"\x08\x04\x10\x03\x18\x05\x20\x02")
BY_HAND = HEADER + _inner(3, _inner(1, JOINTS)) + CONNECTION


def test_a_message_written_by_hand_from_the_field_numbers_is_understood() -> None:
    found = read_monitoring(BY_HAND)
    assert (found.version, found.counter, found.reflected, found.q) == (1, 7, 5, Q)
    assert (found.session, found.quality) == (Session.COMMANDING_ACTIVE, Quality.EXCELLENT)
    assert (found.period, found.multiplier, found.ipo_q) == (0.005, 2, None)


def test_joints_in_a_packed_field_are_understood_too() -> None:
    packed = _field(1, 2, bytes([56]) + b"".join(map(_double, Q)))
    assert read_monitoring(HEADER + _inner(3, _inner(1, packed)) + CONNECTION).q == Q


@pytest.mark.parametrize("version", [1, 2])
def test_a_written_message_can_be_read_again(version: int) -> None:
    sent = dataclasses.replace(MONITORING, version=version)
    datagram = write_monitoring(sent)
    assert version_of(datagram) == version
    assert read_monitoring(datagram) == dataclasses.replace(sent, commanded_tau=None), "which no client needs"
    command = FriCommand(4, 7, q=Q, tau=(1.0,) * 7, io={"gripper_close": False, "force": 0.5})
    assert read_command(write_command(command, version)) == (version, command)


@pytest.mark.parametrize(
    ("command", "control", "overlay"),
    [(CommandKind.NONE, 0, 0), (CommandKind.POSITION, 0, 1), (CommandKind.WRENCH, 1, 1), (CommandKind.TORQUE, 2, 1)],
)
def test_a_cabinet_names_the_control_mode_that_it_allows_for_commands(
    command: CommandKind, control: int, overlay: int
) -> None:
    message = MonitoringMessage.FromString(
        write_monitoring(dataclasses.replace(MONITORING, version=1, command=command))
    )
    assert (message.robot.control, message.ipo.overlay, message.ipo.tracking) == (control, overlay, 1.0)


def test_fri_2_puts_a_length_before_the_message_and_the_crc_of_zlib_behind_it() -> None:
    command = FriCommand(0, 1, q=Q)
    body = write_command(command, 1)
    assert write_command(command, 2) == struct.pack("<I", len(body)) + body + struct.pack("<I", zlib.crc32(body))


def test_an_answer_without_positions_has_no_command_data() -> None:
    assert read_command(write_command(FriCommand(0, 1), 1)) == (1, FriCommand(0, 1))


def _with_joints(*values: float) -> bytes:
    return write_monitoring(dataclasses.replace(MONITORING, q=values))


REFUSED = {
    "nothing": (b"", "neither of FRI 1"),
    "too long": (b"\x0a" * 1501, "at most 1500"),
    "a wrong checksum": (write_monitoring(MONITORING)[:-1] + b"\x00", "checksum"),
    "an answer instead": (write_command(FriCommand(0, 1, q=Q), 2), "allowed: 0x245142"),
    "six joints": (_with_joints(*Q[:6]), "7 finite numbers"),
    "a joint that is no number": (_with_joints(*Q[:6], float("nan")), "7 finite numbers"),
    "no joints": (HEADER + CONNECTION, "without measured joint positions"),
    "an unknown session": (BY_HAND.replace(b"\x08\x04\x10\x03", b"\x08\x09\x10\x03"), "allowed: 0 idle"),
    "no header": (_inner(3, _inner(1, JOINTS)) + CONNECTION, "neither of FRI 1"),
    "cut short": (BY_HAND[:60], "cannot be read"),
}


@pytest.mark.parametrize("case", list(REFUSED))
def test_the_error_for_invalid_bytes_says_what_is_allowed(case: str) -> None:
    datagram, told = REFUSED[case]
    with pytest.raises(ProtocolError, match=told):
        read_monitoring(datagram)


def test_a_message_can_be_read_even_if_a_name_in_it_is_not_valid_text() -> None:
    datagram = write_monitoring(dataclasses.replace(MONITORING, version=1, io={"valve": True}))
    assert read_monitoring(datagram.replace(b"valve", b"val\xff\xfe")).io == {"val\ufffd\ufffd": True}


@pytest.mark.slow
@given(edits=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=8), end=st.integers(0, 400))
@settings(derandomize=True, max_examples=500, deadline=None)
def test_a_message_with_changed_bytes_is_read_or_raises_a_protocol_error(
    edits: list[tuple[int, int]], end: int
) -> None:
    for version in (1, 2):
        datagram = bytearray(write_monitoring(dataclasses.replace(MONITORING, version=version)))
        for place, value in edits:
            datagram[place % len(datagram)] = value
        body = bytes(datagram[: max(end, 1)])
        if version == 2:  # The changed bytes get a valid length and checksum.
            body = struct.pack("<I", len(body)) + body + struct.pack("<I", zlib.crc32(body))
        with contextlib.suppress(ProtocolError):
            read_monitoring(body)
