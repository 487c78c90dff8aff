"""Six simulated servos of an SO-101 leader behind a pseudo-terminal. lerobot uses them like real servos.

They use Feetech's protocol. The instructions and the addresses of the memory are taken from lerobot's
``motors/feetech/tables.py`` and from Feetech's SDK. A packet contains FF FF, id, length, instruction or error,
parameters, and the inverted sum of all bytes after FF FF.
"""

from __future__ import annotations

import json
import os
import pty
import select
import struct
import threading
import tty
from pathlib import Path

MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
_PING, _READ, _WRITE, _SYNC_READ = 1, 2, 3, 0x82
_MODEL, _LIMITS, _POSITION = 3, 9, 56  # Addresses in a servo's memory.
_STS3215 = 777
_LEAST, _GREATEST = 1024, 3071  # Limits of all servos. Their middle is zero degrees.
_PER_DEGREE = 4095 / 360.0


class ServoBus:
    """The bus. ``answers`` is False while its servos have no power. ``has_dropped`` tells that a request got lost."""

    def __init__(self) -> None:
        self.answers, self.has_dropped = True, False
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._memory = {number: bytearray(256) for number in range(1, len(MOTORS) + 1)}
        for memory in self._memory.values():
            struct.pack_into("<H", memory, _MODEL, _STS3215)
            struct.pack_into("<HH", memory, _LIMITS, _LEAST, _GREATEST)
        for motor in MOTORS[:-1]:
            self.turn(motor, 0.0)
        self.open_gripper(1.0)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def turn(self, motor: str, degrees: float) -> None:
        self._place(motor, (_LEAST + _GREATEST) / 2 + degrees * _PER_DEGREE)

    def open_gripper(self, opening: float) -> None:
        """Open the gripper's handle, from 0 for closed to 1."""
        self._place("gripper", _LEAST + opening * (_GREATEST - _LEAST))

    def _place(self, motor: str, count: float) -> None:
        struct.pack_into("<H", self._memory[1 + MOTORS.index(motor)], _POSITION, round(count))

    def calibrate(self, folder: Path, name: str) -> None:
        """Write the calibration that fits these servos, as lerobot-calibrate does."""
        each = {"drive_mode": 0, "homing_offset": 0, "range_min": _LEAST, "range_max": _GREATEST}
        data = {motor: {"id": number} | each for number, motor in enumerate(MOTORS, start=1)}
        (folder / f"{name}.json").write_text(json.dumps(data))

    def close(self) -> None:
        self._ends.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def _run(self) -> None:
        received = b""
        while not self._ends.is_set():
            if not select.select([self._master], [], [], 0.01)[0]:
                continue
            received += os.read(self._master, 1024)
            while len(received) >= 4 and len(received) >= 4 + received[3]:
                packet, received = received[: 4 + received[3]], received[4 + received[3] :]
                self.has_dropped = not self.answers
                if self.answers:
                    self._obey(packet[2], packet[4], packet[5:-1])

    def _obey(self, number: int, instruction: int, parameters: bytes) -> None:
        if instruction == _SYNC_READ:
            first, size = parameters[:2]
            for each in parameters[2:]:
                self._answer(each, bytes(self._memory[each][first : first + size]))
        elif instruction == _READ:
            first, size = parameters
            self._answer(number, bytes(self._memory[number][first : first + size]))
        elif instruction == _WRITE:
            first, data = parameters[0], parameters[1:]
            self._memory[number][first : first + len(data)] = data
            self._answer(number)
        elif instruction == _PING:
            self._answer(number)

    def _answer(self, number: int, data: bytes = b"") -> None:
        body = bytes([number, len(data) + 2, 0]) + data
        os.write(self._master, b"\xff\xff" + body + bytes([~sum(body) & 0xFF]))
