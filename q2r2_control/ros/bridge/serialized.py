"""Messages that are sent again and again with other numbers, read and written as the bytes that the middleware carries.

rclpy makes a Python object of each field and checks it, and makes them anew for each message: for the joint states of
two arms that takes ten times as long as to look at the bytes. Where names and lengths stay the same, so do the places
of the numbers. A message is read by its places only where all else in it equals a message that rclpy has read before;
anything else, such as other names, other lengths, another byte order or another encapsulation, is left to rclpy.
"""

from __future__ import annotations

import math
import struct
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message, serialize_message

from q2r2_control.types import Array

_PLAIN_CDR = b"\x00\x01\x00\x00"  # little endian, numbers aligned by their size
_HEADER = len(_PLAIN_CDR)
_NATIVE = np.dtype(np.float64).newbyteorder("<") == np.dtype(np.float64)
_STAMP = struct.Struct("<iI")  # seconds and nanoseconds
_SECOND = 1_000_000_000  # [ns]
_KEPT = 16  # layouts of one topic: that many publishers may send other names
_LONGEST = 1 << 16  # of a message whose layout is kept [bytes]


class Numbers(NamedTuple):
    """What was read: a message of the same names and lengths, and the numbers of this one."""

    like: Any  # all but its float64 and its stamps holds; the same object as long as nothing else changes
    values: Array  # all float64 fields, in the order of the fields
    stamp: int  # the first one [ns]; 0 where there is none


class _Places:
    """Where things are in a serialized message, as the Common Data Representation of DDS aligns them."""

    def __init__(self, message: Any) -> None:
        self.end = _HEADER
        self.numbers: list[int] = []  # of float64
        self.stamps: list[int] = []
        self.stamp = 0  # the first one's value [ns]
        self.holders: list[tuple[Any, str, int | None]] = []  # where numbers are in the message: how many, None: one
        self.times: list[Any] = []  # the stamps in the message
        self.fixed: list[tuple[int, int]] = [(0, _HEADER)]  # from, to: what is neither of these nor padding
        self._values: list[float] = []
        self._fields(message)
        self.values = np.array(self._values, np.float64)
        offsets = np.array(self.numbers, np.intp)
        self.index = offsets[:, None] + np.arange(8)
        adjacent = len(offsets) > 0 and bool((np.diff(offsets) == 8).all())
        self.start = int(offsets[0]) if adjacent else None  # where all numbers are one block

    def _fields(self, message: Any) -> None:
        for name, kind in message.get_fields_and_field_types().items():
            value = getattr(message, name)
            if kind in ("double", "sequence<double>"):
                self.holders.append((message, name, None if kind == "double" else len(value)))
            self._field(value, kind)

    def _field(self, value: Any, kind: str) -> None:
        if kind == "double":
            self.numbers.append(self._take(8, 8))
            self._values.append(value)
        elif kind == "sequence<double>":
            self._fix(4, 4)
            if len(value):
                at = self._take(8, 8 * len(value))
                self.numbers.extend(range(at, at + 8 * len(value), 8))
                self._values.extend(value)
        elif kind == "builtin_interfaces/Time":
            self.stamps.append(self._take(4, 8))
            self.times.append(value)
            if len(self.stamps) == 1:
                self.stamp = int(value.sec) * _SECOND + int(value.nanosec)
        elif kind == "string":
            self._fix(4, 4 + len(value.encode(errors="replace")) + 1)
        elif kind.startswith("sequence<"):
            self._fix(4, 4)
            for one in value:
                self._field(one, kind[len("sequence<") : -1])
        elif kind in ("int32", "uint32"):
            self._fix(4, 4)
        elif "/" in kind:
            self._fields(value)
        else:
            raise TypeError(f"a field of type {kind}")

    def gaps(self) -> list[tuple[int, int]]:
        """From, to: what is between numbers and stamps, padding and all."""
        varying = sorted((at, at + 8) for at in (*self.numbers, *self.stamps))
        begins, ends = [0, *(end for _, end in varying)], [*(begin for begin, _ in varying), self.end]
        return [(begin, end) for begin, end in zip(begins, ends, strict=True) if begin < end]

    def _take(self, alignment: int, size: int) -> int:
        at = self.end + (_HEADER - self.end) % alignment
        self.end = at + size
        return at

    def _fix(self, alignment: int, size: int) -> None:
        at = self._take(alignment, size)
        if at == self.fixed[-1][1]:
            self.fixed[-1] = self.fixed[-1][0], at + size
        else:
            self.fixed.append((at, at + size))


class MessageWriter:
    """Serializes a message whose numbers and stamps change, and nothing else.

    ``numbers`` (n,) are all its float64 fields, in the order of the fields, for the caller to set. With a middleware
    that serializes in another way, rclpy does it.
    """

    def __init__(self, message: Any) -> None:
        """``message`` has the names and lengths; it is the writer's from then on."""
        self._message, self._places = message, _Places(message)
        data = serialize_message(message)
        self._is_plain = _NATIVE and _is_plain(data, self._places) and _same_numbers(data, self._places)
        # What serialize_message gives may be longer than the message, with whatever the memory held.
        self._data = bytearray(data[: self._places.end] if self._is_plain else data)
        self._bytes = np.frombuffer(self._data, np.uint8)
        self.numbers = self._places.values.copy()
        self._raw = self.numbers.view(np.uint8).reshape(-1, 8)

    def at(self, t: float) -> bytes:
        """The message, for a publisher, with all its stamps ``t`` [s]; not negative."""
        whole = math.floor(max(t, 0.0))
        nanoseconds = min(round((max(t, 0.0) - whole) * 1e9), _SECOND - 1)
        if not self._is_plain:
            return self._by_rclpy(whole, nanoseconds)
        self._bytes[self._places.index] = self._raw
        for stamp in self._places.stamps:
            _STAMP.pack_into(self._data, stamp, whole, nanoseconds)
        return bytes(self._data)

    def _by_rclpy(self, whole: int, nanoseconds: int) -> bytes:
        values = iter(self.numbers.tolist())
        for holder, name, count in self._places.holders:
            setattr(holder, name, next(values) if count is None else list(islice(values, count)))
        for time in self._places.times:
            time.sec, time.nanosec = whole, nanoseconds
        return bytes(serialize_message(self._message))


class MessageReader:
    """Reads serialized messages of one kind, such as a topic brings to a subscription that is ``raw``."""

    def __init__(self, kind: type) -> None:
        self._kind = kind
        self._layouts: list[_Layout] = []  # the last used first

    def read(self, data: bytes) -> Numbers | None:
        """What is in it; None where rclpy finds no message in it, which a subscription drops as well."""
        for place, layout in enumerate(self._layouts):
            if (numbers := layout.read(data)) is not None:
                if place:  # those that are in use stay
                    self._layouts.insert(0, self._layouts.pop(place))
                return numbers
        try:
            message = deserialize_message(data, self._kind)
        except rclpy_implementation.RMWError:
            return None
        layout = _Layout(message)
        if len(data) <= _LONGEST and layout.fits(data):
            self._layouts = [layout, *self._layouts[: _KEPT - 1]]
        return layout.own


class _Layout:
    """What messages have in common that are all alike but for their numbers and stamps."""

    def __init__(self, message: Any) -> None:
        self._message, self._places = message, _Places(message)
        self.own = Numbers(message, self._places.values, self._places.stamp)
        self._fixed: list[tuple[int, int, bytes]] = []
        self._seen: list[tuple[int, int, bytes]] = []  # the gaps of the last message: padding is mostly alike as well

    def fits(self, data: bytes) -> bool:
        """Whether these bytes, of which the message was read, are what is found by places."""
        places, again = self._places, serialize_message(self._message)
        self._fixed = [(begin, end, again[begin:end]) for begin, end in places.fixed]
        plain = _NATIVE and _is_plain(again, places) and _same_numbers(again, places)
        return plain and self._matches(data) and _same_numbers(data, places)

    def read(self, data: bytes) -> Numbers | None:
        """The numbers in a message like this one; None where it is another."""
        places = self._places
        if len(data) < places.end:
            return None
        for begin, end, seen in self._seen:
            if data[begin:end] != seen:
                if not self._matches(data):
                    return None
                break
        if places.start is not None:
            values = np.frombuffer(data, np.float64, len(places.numbers), places.start)
        else:
            values = np.frombuffer(data, np.uint8)[places.index].view(np.float64).reshape(-1)
        if not places.stamps:
            return Numbers(self._message, values, 0)
        second, nanosecond = _STAMP.unpack_from(data, places.stamps[0])
        return Numbers(self._message, values, second * _SECOND + nanosecond)

    def _matches(self, data: bytes) -> bool:
        fits = len(data) >= self._places.end and all(data[begin:end] == fixed for begin, end, fixed in self._fixed)
        if fits:
            self._seen = [(begin, end, data[begin:end]) for begin, end in self._places.gaps()]
        return fits


def _is_plain(data: bytes, places: _Places) -> bool:
    return data[:_HEADER] == _PLAIN_CDR and len(data) >= places.end


def _same_numbers(data: bytes, places: _Places) -> bool:
    """Whether the numbers that the message has are where they are looked for, to the last bit."""
    return np.frombuffer(data, np.uint8)[places.index].tobytes() == places.values.tobytes()
