"""Messages of KUKA's Fast Robot Interface, FRI 1 and 2, as classes of the package ``protobuf``.

``_MESSAGES`` was written for interoperation, with the field numbers of the public client kits 1.15 and 2.7. Here,
enumerations are plain integers, so that a message with an unknown value of a newer version can still be parsed.
"""

from __future__ import annotations

from typing import Any

from q2r2_control.extras import importing

with importing("fri", "the Fast Robot Interface"):
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

_PACKAGE = "q2r2.fri"
_Field = descriptor_pb2.FieldDescriptorProto
_TYPES = {
    "uint": _Field.TYPE_UINT32,
    "uint64": _Field.TYPE_UINT64,
    "int": _Field.TYPE_INT32,
    "double": _Field.TYPE_DOUBLE,
    "bytes": _Field.TYPE_BYTES,
}
# For each message, the number and the type of each field. A type that is no key of _TYPES is a message. A type with []
# is repeated, and a type with ! is required.
_MESSAGES: dict[str, dict[str, tuple[int, str]]] = {
    "Header": {"identifier": (1, "uint!"), "counter": (2, "uint!"), "reflected": (3, "uint!")},
    "Joints": {"value": (1, "double[]")},
    "Stamp": {"sec": (1, "uint"), "nanosec": (2, "uint")},
    "Io": {
        "name": (1, "bytes!"),
        "type": (2, "int!"),
        "direction": (3, "int!"),
        "digital": (4, "uint64"),
        "analog": (5, "double"),
    },
    "RobotInfo": {
        "joints": (1, "int"),
        "safety": (2, "int"),
        "drives": (5, "int[]"),
        "operation": (6, "int"),
        "control": (7, "int"),
    },
    "MonitorData": {
        "q": (1, "Joints"),
        "tau": (2, "Joints"),
        "commanded_q": (3, "Joints"),
        "commanded_tau": (4, "Joints"),
        "external_tau": (5, "Joints"),
        "io": (8, "Io[]"),
        "stamp": (15, "Stamp"),
    },
    "ConnectionInfo": {
        "session": (1, "int!"),
        "quality": (2, "int!"),
        "period": (3, "uint"),
        "multiplier": (4, "uint"),
    },
    "IpoData": {
        "q": (1, "Joints"),
        "command_mode": (10, "int"),
        "overlay": (11, "int"),
        "tracking": (12, "double"),
    },
    "Monitoring": {
        "header": (1, "Header!"),
        "robot": (2, "RobotInfo"),
        "data": (3, "MonitorData"),
        "connection": (4, "ConnectionInfo"),
        "ipo": (5, "IpoData"),
    },
    "Wrench": {"element": (1, "double[]")},
    "CommandData": {
        "q": (1, "Joints"),
        "wrench": (2, "Wrench"),
        "tau": (3, "Joints"),
        "io": (5, "Io[]"),
    },
    "Command": {"header": (1, "Header!"), "data": (2, "CommandData")},
}


def _pool() -> descriptor_pool.DescriptorPool:
    file = descriptor_pb2.FileDescriptorProto(name="q2r2_fri.proto", package=_PACKAGE, syntax="proto2")
    for message, fields in _MESSAGES.items():
        described = file.message_type.add(name=message)
        for name, (number, kind) in fields.items():
            label = _Field.LABEL_OPTIONAL
            if kind.endswith("[]"):
                kind, label = kind[:-2], _Field.LABEL_REPEATED
            elif kind.endswith("!"):
                kind, label = kind[:-1], _Field.LABEL_REQUIRED
            field = described.field.add(name=name, number=number, label=label)
            if kind in _TYPES:
                field.type = _TYPES[kind]
            else:
                field.type, field.type_name = _Field.TYPE_MESSAGE, f".{_PACKAGE}.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return pool


def _message(name: str) -> Any:
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{_PACKAGE}.{name}"))


_POOL = _pool()
MonitoringMessage, CommandMessage = _message("Monitoring"), _message("Command")
