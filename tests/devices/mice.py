"""Simulated SpaceMice, which tests use instead of hidapi's devices. They give the bytes of real HID reports."""

from __future__ import annotations

import queue
import struct
import threading
from collections.abc import Callable
from typing import Any

FULL = 350  # Reading of an axis at full deflection.


def translation(right: int = 0, back: int = 0, down: int = 0) -> bytes:
    """Return the HID report 1 of a SpaceMouse model that sends translation and rotation in separate reports."""
    return struct.pack("<B3h", 1, right, back, down)


def rotation(about_right: int = 0, about_back: int = 0, about_down: int = 0) -> bytes:
    return struct.pack("<B3h", 2, about_right, about_back, about_down)


def both(*axes: int) -> bytes:
    """Return the HID report 1 of a SpaceMouse model that sends all six axes in the 12 bytes of one report."""
    return struct.pack("<B6h", 1, *axes)


def buttons(left: bool = False, right: bool = False) -> bytes:
    return bytes([3, left + 2 * right])


class Mouse:
    """One SpaceMouse, which can be unplugged. ``send`` returns when the reader has taken all reports."""

    def __init__(self, path: str, serial: str = "", usage: tuple[int, int] = (1, 8)) -> None:
        self.info = {
            "path": path.encode(),
            "vendor_id": 0x256F,
            "serial_number": serial,
            "product_string": "SpaceMouse Compact",
            "usage_page": usage[0],
            "usage": usage[1],
        }
        self.plugged = True
        self._reports: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._waits = threading.Event()

    def send(self, *reports: bytes) -> None:
        self._waits.clear()
        for report in reports:
            self._reports.put(report)
        self._waits.wait()

    def read(self, size: int, timeout_ms: int) -> list[int]:
        if not self.plugged:
            raise OSError("read error")
        if self._reports.empty():
            self._waits.set()
        try:
            return list(self._reports.get(timeout=timeout_ms / 1000.0)[:size])
        except queue.Empty:
            return []


class Hid:
    """A replacement for hidapi's module, which finds the given mice."""

    def __init__(self, *mice: Mouse) -> None:
        self.mice = mice

    def enumerate(self) -> list[dict[str, Any]]:
        return [mouse.info for mouse in self.mice if mouse.plugged]

    def device(self) -> Opened:
        return Opened(self)


class Opened:
    """A replacement for hidapi's class ``device``, with which a program opens a mouse."""

    def __init__(self, hid: Hid) -> None:
        self._hid = hid

    def open_path(self, path: bytes) -> None:
        (self.read,) = [mouse.read for mouse in self._hid.mice if mouse.info["path"] == path]

    def close(self) -> None: ...


def until(condition: Callable[[], bool]) -> None:
    """Wait until ``condition`` holds. There is no timeout, because another thread may take long."""
    while not condition():
        threading.Event().wait(0.001)
