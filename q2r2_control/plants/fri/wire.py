"""Messages of KUKA's Fast Robot Interface, converted from and to datagrams.

A cabinet sends a :class:`Monitoring` datagram in every period, and its client answers with a :class:`FriCommand`. FRI 1
sends the protobuf message itself. FRI 2 puts the message's length before it and a CRC-32 behind it, both as uint32,
little endian.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Container
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from typing import Any

import numpy as np

from q2r2_control.errors import ProtocolError
from q2r2_control.extras import importing
from q2r2_control.plants.fri.schema import CommandMessage, MonitoringMessage

with importing("fri", "the Fast Robot Interface"):
    from google.protobuf.message import DecodeError, EncodeError

JOINTS = 7
LONGEST = 1500  # Longest datagram [bytes].
_MONITORING, _COMMAND = 0x245142, 0x34001  # Identifiers of the two messages.
_FIRST_FIELD = 0x0A  # First byte of a protobuf message whose field 1 is itself a message.
_LENGTH = struct.Struct("<I")

Joints = tuple[float, ...]  # The positions, velocities or torques of seven joints.
IoValue = bool | int | float


def joints_of(values: np.ndarray) -> Joints:
    return tuple(values.tolist())


class Session(IntEnum):
    """The state of the session between a cabinet and its client."""

    IDLE = 0
    MONITORING_WAIT = 1
    MONITORING_READY = 2
    COMMANDING_WAIT = 3
    COMMANDING_ACTIVE = 4


class Quality(IntEnum):
    """Quality of the connection, judged by the share of answers in time. Only GOOD and EXCELLENT allow commands."""

    POOR = 0
    FAIR = 1
    GOOD = 2
    EXCELLENT = 3


class Safety(IntEnum):
    """The stop that the cabinet's safety controller asks for."""

    NORMAL = 0
    STOP_0_OR_1 = 1
    STOP_1_ON_PATH = 2
    STOP_2 = 3


class Operation(IntEnum):
    """The position of the cabinet's key switch."""

    T1 = 0
    T2 = 1
    AUTOMATIC = 2


class Drives(IntEnum):
    """The state of an arm's drives. If the drives of the joints have different states, it is the lowest of them."""

    OFF = 0
    TRANSITIONING = 1
    ACTIVE = 2


def in_words(state: IntEnum) -> str:
    return state.name.lower().replace("_", " ")


class CommandKind(IntEnum):
    """The commands that the Sunrise application allows a client to overlay."""

    NONE = 0
    POSITION = 1
    WRENCH = 2
    TORQUE = 3
    CARTESIAN_POSE = 4


# Control modes of an arm, overlays of its motion, and directions of inputs and outputs, as numbers of the protocol.
_POSITION_CONTROL, _CONTROL_MODES = 0, {CommandKind.WRENCH: 1, CommandKind.TORQUE: 2}
_NO_OVERLAY, _JOINT_OVERLAY = 0, 1
_IN, _OUT = 0, 1


@dataclass(frozen=True, slots=True)
class Monitoring:
    """A message of a cabinet. Joints are A1 .. A7 [rad, Nm]. A field is None if the message does not contain it."""

    version: int  # Version of FRI, 1 or 2.
    counter: int  # Counter of the cabinet's messages.
    reflected: int  # Counter of the client's message that the cabinet received last.
    session: Session
    quality: Quality
    period: float  # Time between two messages of the cabinet [s].
    multiplier: int  # The cabinet expects one answer per this number of messages.
    q: Joints  # Measured positions.
    stamp: float = 0.0  # Time of the cabinet's clock [s].
    tau: Joints | None = None  # Measured torques.
    external_tau: Joints | None = None  # Torques that contacts cause, as the cabinet estimates them.
    commanded_q: Joints | None = None  # Commanded positions, only in FRI 1.
    ipo_q: Joints | None = None  # Position of the cabinet's own motion (ipo), which a client's command overlays.
    command: CommandKind = CommandKind.NONE
    safety: Safety = Safety.NORMAL
    operation: Operation = Operation.AUTOMATIC
    drives: Drives = Drives.ACTIVE
    io: dict[str, IoValue] = field(default_factory=dict)  # Inputs and outputs that the application registered.
    outputs: frozenset[str] = frozenset()  # Names in ``io`` that a client may write.
    # Torques of the cabinet's controller plus the client's overlay. A simulated cabinet writes them; no client reads
    # them.
    commanded_tau: Joints | None = None

    def output(self, name: str, value: IoValue) -> IoValue | None:
        """Return ``value`` in the type of the cabinet's output ``name``; None if there is no such output of this kind.

        KUKA's own clients raise an exception for an output that the cabinet does not list.
        """
        theirs = self.io.get(name) if name in self.outputs else None
        if theirs is None or isinstance(theirs, float) is not isinstance(value, float):
            return None
        return type(theirs)(value)


@dataclass(frozen=True, slots=True)
class FriCommand:
    """An answer of a client."""

    counter: int  # Counter of the client's messages, from 0.
    reflected: int  # Counter of the message that is answered.
    q: Joints | None = None  # Positions that the arm has to reach after one answer period [rad].
    tau: Joints | None = None  # Torques that are added to the cabinet's own joint impedance [Nm].
    io: dict[str, IoValue] = field(default_factory=dict)


def read_monitoring(datagram: bytes) -> Monitoring:
    """Return a cabinet's message; raises :class:`ProtocolError` if the bytes are no such message."""
    version, message = _parsed(datagram, MonitoringMessage, _MONITORING)
    data, connection, ipo, robot = message.data, message.connection, message.ipo, message.robot
    if (q := _joints(data, "q")) is None:
        raise ProtocolError("FRI monitoring message without measured joint positions: allowed: seven of them")
    if not 1 <= connection.period <= 100:
        raise ProtocolError(f"FRI send period of {connection.period} ms: allowed: 1 .. 100")
    return Monitoring(
        version=version,
        counter=message.header.counter,
        reflected=message.header.reflected,
        session=_member(Session, connection.session),
        quality=_member(Quality, connection.quality),
        period=1e-3 * connection.period,
        multiplier=max(connection.multiplier, 1),
        q=q,
        stamp=data.stamp.sec + 1e-9 * data.stamp.nanosec,
        tau=_joints(data, "tau"),
        external_tau=_joints(data, "external_tau"),
        commanded_q=_joints(data, "commanded_q"),
        ipo_q=_joints(ipo, "q"),
        command=_member(CommandKind, ipo.command_mode),
        safety=_member(Safety, robot.safety),
        operation=_member(Operation, robot.operation),
        drives=_member(Drives, min(robot.drives, default=Drives.ACTIVE)),
        io=_io_of(data.io),
        outputs=frozenset([_name_of(io.name) for io in data.io if io.direction == _OUT]),
    )


def write_monitoring(monitoring: Monitoring) -> bytes:
    """Return the datagram of a cabinet's message, for a program that simulates a cabinet."""
    message = MonitoringMessage()
    _set_header(message, _MONITORING, monitoring.counter, monitoring.reflected)
    message.robot.joints, message.robot.control = JOINTS, _CONTROL_MODES.get(monitoring.command, _POSITION_CONTROL)
    message.robot.safety, message.robot.operation = monitoring.safety, monitoring.operation
    message.robot.drives.extend([monitoring.drives] * JOINTS)
    connection = message.connection
    connection.session, connection.quality = monitoring.session, monitoring.quality
    connection.period, connection.multiplier = round(1e3 * monitoring.period), monitoring.multiplier
    message.data.stamp.sec = int(monitoring.stamp)
    message.data.stamp.nanosec = int(1e9 * (monitoring.stamp % 1.0))
    for name in ("q", "tau", "external_tau", "commanded_q", "commanded_tau"):
        _set_joints(message.data, name, getattr(monitoring, name))
    _set_joints(message.ipo, "q", monitoring.ipo_q)
    message.ipo.command_mode = monitoring.command
    message.ipo.overlay = _JOINT_OVERLAY if monitoring.command is not CommandKind.NONE else _NO_OVERLAY
    message.ipo.tracking = float(monitoring.session is Session.COMMANDING_ACTIVE)
    _set_io(message.data.io, monitoring.io, monitoring.outputs)
    return _datagram(message, monitoring.version)


def read_command(datagram: bytes) -> tuple[int, FriCommand]:
    """Return version and answer of a client; raises :class:`ProtocolError` if the bytes are not an answer."""
    version, message = _parsed(datagram, CommandMessage, _COMMAND)
    data, header = message.data, message.header
    return version, FriCommand(
        header.counter, header.reflected, _joints(data, "q"), _joints(data, "tau"), _io_of(data.io)
    )


def write_command(command: FriCommand, version: int) -> bytes:
    """Return the datagram of an answer in FRI ``version`` 1 or 2."""
    message = CommandMessage()
    _set_header(message, _COMMAND, command.counter, command.reflected)
    _set_joints(message.data, "q", command.q)
    _set_joints(message.data, "tau", command.tau)
    _set_io(message.data.io, command.io, command.io)
    return _datagram(message, version)


def version_of(datagram: bytes) -> int:
    """Return the version of FRI, 1 or 2.

    A datagram of FRI 2 begins with a length of at most 1500, so that its second byte is 5 at most. In FRI 1 this byte
    is larger.
    """
    return 1 if len(datagram) > 1 and datagram[0] == _FIRST_FIELD and datagram[1] > 5 else 2


def _parsed(datagram: bytes, kind: Any, identifier: int) -> tuple[int, Any]:
    if len(datagram) > LONGEST:
        raise ProtocolError(f"FRI datagram of {len(datagram)} bytes: allowed: at most {LONGEST}")
    version, body = version_of(datagram), datagram
    if version == 2:
        length = _LENGTH.unpack_from(datagram)[0] if len(datagram) >= 8 else -1
        if length != len(datagram) - 8:
            raise ProtocolError(f"FRI datagram of {len(datagram)} bytes is neither of FRI 1 nor has FRI 2's length")
        body = datagram[4:-4]
        if zlib.crc32(body) != _LENGTH.unpack_from(datagram, len(datagram) - 4)[0]:
            raise ProtocolError("FRI 2 datagram whose checksum is wrong")
    try:
        message = kind.FromString(body)
    except DecodeError as error:
        raise ProtocolError(f"FRI datagram of {len(datagram)} bytes that cannot be read: {error!s:.80}") from error
    if message.header.identifier != identifier:
        raise ProtocolError(f"FRI message {message.header.identifier:#x}: allowed: {identifier:#x}")
    return version, message


def _datagram(message: Any, version: int) -> bytes:
    try:
        body: bytes = message.SerializeToString()
    except EncodeError as error:
        raise ProtocolError(f"FRI message that cannot be written: {error!s:.80}") from error
    if version == 1:
        return body
    return _LENGTH.pack(len(body)) + body + _LENGTH.pack(zlib.crc32(body))


def _set_header(message: Any, identifier: int, counter: int, reflected: int) -> None:
    header = message.header
    header.identifier, header.counter, header.reflected = identifier, counter & 0xFFFFFFFF, reflected & 0xFFFFFFFF


def _joints(message: Any, name: str) -> Joints | None:
    """Return the seven numbers of a field, or None if it is empty; raises ProtocolError for other contents."""
    values = tuple(getattr(message, name).value)
    if not values:
        return None
    if len(values) != JOINTS or not math.isfinite(sum(values)):
        raise ProtocolError(f"FRI {name} = {values!s:.80}: allowed: {JOINTS} finite numbers")
    return values


def _set_joints(message: Any, name: str, values: Joints | None) -> None:
    if values is not None:
        getattr(message, name).value.extend(values)


# Calling an enum takes ten times as long as a look-up in this dictionary, and each message needs six look-ups.
_ENUMS: tuple[type[IntEnum], ...] = (Session, Quality, CommandKind, Safety, Operation, Drives)
_MEMBERS = {kind: {one.value: one for one in kind} for kind in _ENUMS}


def _member(kind: type[IntEnum], value: int) -> Any:
    if value not in _MEMBERS[kind]:
        allowed = ", ".join(f"{one.value} {one.name.lower()}" for one in kind)
        raise ProtocolError(f"FRI {kind.__name__.lower()} {value}: allowed: {allowed}")
    return _MEMBERS[kind][value]


def _io_of(values: Any) -> dict[str, IoValue]:
    """Return the values by name: a bool, an int for a value of several bits, or a float for an analog value."""
    kinds: tuple[Any, ...] = (lambda io: bool(io.digital), lambda io: io.digital, lambda io: io.analog)
    return {_name_of(io.name): kinds[io.type](io) for io in values if 0 <= io.type < len(kinds)}


@lru_cache(maxsize=64)
def _name_of(name: bytes) -> str:
    return name.decode(errors="replace")


def _set_io(message: Any, values: dict[str, IoValue], outputs: Container[str]) -> None:
    for name, value in values.items():
        io = message.add(name=name.encode(), direction=_OUT if name in outputs else _IN)
        if isinstance(value, float):
            io.type, io.analog = 2, value
        else:
            io.type, io.digital = 0 if isinstance(value, bool) else 1, int(value)
