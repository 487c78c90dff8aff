"""A foot pedal, or a key of a keyboard, that engages arms while it is held. Linux only."""

from __future__ import annotations

import os
import select
import struct

from q2r2_control import InputError
from q2r2_devices.reading import READ_TIMEOUT

# struct input_event of Linux (Documentation/input/input.rst): the time in two longs, then type, code and value.
_EVENT = struct.Struct("@llHHi")
_SYN, _DROPPED = 0, 3  # EV_SYN and SYN_DROPPED: the reader was too slow, and the kernel has dropped events.
_KEY = 1  # EV_KEY. Its value is 0 for released, 1 for pressed, and 2 for the repetitions while a key is held.


class Pedal:
    """Reads whether any key of an event device is held, as a :class:`~q2r2_devices.reading.Device`.

    ``path`` is a file such as ``/dev/input/by-id/usb-...-event-kbd``. USB pedals are keyboards with one or a few keys.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._file: int | None = None

    def open(self) -> str:
        try:
            self._file = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)
        except PermissionError as error:
            cure = "sudo usermod -aG input $USER, and log in again"
            raise InputError(f"no permission to read {self._path}; {cure}") from error
        self._held: set[int] = set()
        return self._path

    def read(self) -> bool | None:
        assert self._file is not None
        if not select.select([self._file], [], [], READ_TIMEOUT)[0]:
            return None
        events = os.read(self._file, 64 * _EVENT.size)
        if not events:
            raise EOFError(f"{self._path} has ended")
        for _, _, kind, code, value in _EVENT.iter_unpack(events):
            if (kind, code) == (_SYN, _DROPPED):
                self._held.clear()  # A release may be among the dropped events. A held key repeats itself.
            elif kind == _KEY and value:
                self._held.add(code)
            elif kind == _KEY:
                self._held.discard(code)
        return bool(self._held)

    def close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
