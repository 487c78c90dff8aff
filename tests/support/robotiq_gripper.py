"""A simulated Robotiq gripper, which pymodbus serves over Modbus. Its fingers move by one step at each reading."""

from __future__ import annotations

import asyncio
import struct
import threading
from collections.abc import Coroutine, Sequence
from typing import Any

from pymodbus.framer import FramerType
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

UNIT = 9
_STEP = 25  # Change of the gripper's position in one step. The full range is 255.


class SimulatedGripper:
    """A context manager with a thread that serves the gripper. ``stop`` drops and ``start`` restores the connection."""

    def __init__(self, framer: FramerType = FramerType.SOCKET) -> None:
        self._framer, self.port = framer, 0
        self.silent = False  # If True, requests get no answer.
        self.reads, self.activation = 0, 3  # Number of reads, and number of reads until the gripper is active.
        self.power_off()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._server: Any = None

    def power_off(self) -> None:
        """Forget everything except the position of the fingers."""
        self.written: list[tuple[int, ...]] = []  # The six bytes of each request.
        self.position, self.fault = getattr(self, "position", 120), 0
        self.object_at = 255  # Position beyond which the fingers cannot close.
        self.request: tuple[int, ...] = (0,) * 6
        self._waits = self.activation

    def activate(self) -> None:
        """Become active, as if an earlier run had activated the gripper."""
        self.request, self._waits = (1, *self.request[1:]), 0

    @property
    def activations(self) -> int:
        return sum(request == (1, 0, 0, 0, 0, 0) for request in self.written)

    def __enter__(self) -> SimulatedGripper:
        self._thread.start()
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def start(self) -> None:
        self._await(self._start())

    def stop(self) -> None:
        if self._server is not None:
            self._await(self._server.shutdown())
        self._server = None

    async def _start(self) -> None:
        registers = [SimData(first, count=3, values=0, datatype=DataType.REGISTERS) for first in (0x03E8, 0x07D0)]
        self._server = ModbusTcpServer(
            SimDevice(UNIT, simdata=registers, action=self._act),
            framer=self._framer,
            address=("127.0.0.1", self.port),
            trace_pdu=lambda sending, pdu: None if sending and self.silent else pdu,
        )
        await self._server.serve_forever(background=True)
        self.port = self._server.transport.sockets[0].getsockname()[1]

    def _await(self, doing: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(doing, self._loop).result()

    async def _act(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: Sequence[int] | None
    ) -> None:
        assert (function, address, count) in ((16, 0x03E8, 3), (4, 0x07D0, 3))
        if values is not None:
            self._take(tuple(struct.pack(">3H", *values)))
        else:
            self.reads += 1
            registers[address - start : address - start + count] = struct.unpack(">3H", bytes(self._move()))

    def _take(self, request: tuple[int, ...]) -> None:
        self.written.append(request)
        if not request[0] & 1:
            self._waits, self.fault = self.activation, 0
        self.request = request

    def _move(self) -> tuple[int, ...]:
        """Move a step, and return the six bytes that are read."""
        asked, goes, state, detected = self.request[0] & 1, self.request[0] >> 3 & 1, 0, 0
        if asked:
            self._waits = max(self._waits - 1, 0)
            state = 1 if self._waits else 3
        if goes and state == 3 and self.fault < 10:
            wanted = min(self.request[3], self.object_at)
            self.position += min(max(wanted - self.position, -_STEP), _STEP)
            detected = 0 if self.position != wanted else 2 if wanted < self.request[3] else 3
        return (asked | goes << 3 | state << 4 | detected << 6, 0, self.fault, self.request[3], self.position, 0)
