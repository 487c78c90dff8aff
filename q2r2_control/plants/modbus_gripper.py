"""A Robotiq gripper that a plant commands by Modbus, in a thread of its own, so that the loop never waits for it.

Hand-E, 2F-85 and 2F-140 have the same registers (chapter 4 of their instruction manuals).

**Safety.** Until an opening is measured, the bodies of the fingers cover all positions of the fingers. After that, they
cover all openings that were measured or commanded recently. An activation opens and closes the fingers fully. The
gripper is therefore activated only before an opening is measured in a run. If the newest measurement of the opening, or
the command that applied at that measurement, is older than ``MODBUS_DELAY``, the opening is no longer known.
Supervision then does not allow another opening.
"""

from __future__ import annotations

import logging
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Event, Thread
from typing import Any

from q2r2_control.config.fri import MODBUS_DELAY, ModbusGripperConfig
from q2r2_control.errors import ConfigError
from q2r2_control.extras import install_line

# First register to write, and first register to read. Three registers of two bytes each are written or read.
_OUTPUTS, _INPUTS = 0x03E8, 0x07D0
_PERIOD = 0.025  # Time between two readings. A new opening is written at the same time [s].
_AGAIN = 1.0  # Time after which a lost connection is tried again [s].
_TIMEOUT, _REPEATS = 0.3, 1  # Time to wait for an answer [s], and the number of repeated requests.
_ACTIVATE, _GO = 0x01, 0x08  # The bits rACT and rGTO of the action request.
_RESET, _ACTIVATION = bytes(6), bytes((_ACTIVATE, 0, 0, 0, 0, 0))
_MAJOR = 0x0A  # Only a reset ends a fault with this number or a greater one.
_FAULTS = {  # Faults with other numbers end with an activation, or when they are read.
    0x08: "too hot, it has to cool down",
    0x0A: "supply voltage too low",
    0x0B: "automatic release in progress",
    0x0C: "internal fault",
    0x0D: "activation failed, something may be in the fingers' way",
    0x0E: "overcurrent",
    0x0F: "automatic release completed",
}
_logger = logging.getLogger(__name__)
# Without a handler, each attempt to connect again would be printed.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """One reading of a gripper."""

    requested: bool  # The register gACT: an activation was requested.
    activated: bool  # The register gSTA: the activation is complete.
    holds: bool  # The register gOBJ: an object has stopped the fingers while they opened or closed.
    fault: int  # The register gFLT: the number of the fault.
    position: int  # The register gPO: the position, from about 0 for open to 255 for closed.

    @classmethod
    def of(cls, registers: Sequence[int]) -> GripperStatus:
        """Decode the three input registers; raises struct.error for another number of registers."""
        status, _, fault, _, position, _ = struct.pack(">3H", *registers)
        return cls(bool(status & 0x01), status >> 4 & 0x03 == 3, status >> 6 in (1, 2), fault & 0x0F, position)

    @property
    def ready(self) -> bool:
        """Whether the gripper follows commands."""
        return self.activated and self.fault < _MAJOR

    @property
    def trouble(self) -> str:
        """The fault in words, or "" if there is none."""
        return f"fault 0x{self.fault:02x}, {_FAULTS[self.fault]}" if self.fault in _FAULTS else ""


class ModbusGripper:
    """The gripper of one arm in one run. Openings go from 0 for closed to 1 for open."""

    def __init__(self, arm: str, config: ModbusGripperConfig) -> None:
        """Raise :class:`ConfigError` if pymodbus is not installed."""
        self._arm, self._config, self._client = arm, config, _client(arm, config)
        self._where = f"{config.modbus}, unit {config.unit}"
        self.status: GripperStatus | None = None  # None if the gripper does not answer.
        self._wanted: float | None = None
        # The measured opening, and the time at which its exchange with the gripper began [s]. The command that applied
        # at the measurement was chosen at this time. None if the opening is not known.
        self._measured: tuple[float, float] | None = None
        self._used = False  # Whether the gripper was ready in this run.
        self._sent, self._told = b"", ""
        self._closing = Event()
        self._thread = Thread(target=self._serve, name=f"{arm} gripper", daemon=True)

    def start(self) -> None:
        """Start the thread, which reads the gripper regularly. The first :meth:`command` activates the gripper."""
        self._thread.start()

    def command(self, opening: float) -> None:
        """Let the gripper move to ``opening``, from 0 for closed to 1 for open, until the next call."""
        self._wanted = opening

    @property
    def opening(self) -> float | None:
        """The measured opening; None if it is not known."""
        measured = self._measured
        return None if measured is None or time.monotonic() - measured[1] > MODBUS_DELAY else measured[0]

    def in_words(self) -> str:
        """Return the position and the state of the gripper in words."""
        if (status := self.status) is None:
            return f"{self._where}: does not answer"
        state = "active" if status.activated else "not active until a run begins"
        notes = (f"{self._where}: {state}", f"position {status.position} of 255")
        return ", ".join(filter(None, (*notes, "holds something" if status.holds else "", status.trouble)))

    def close(self) -> None:
        """End the thread of :meth:`start`. The gripper stays as it is."""
        self._closing.set()
        self._thread.join()

    def _serve(self) -> None:
        while not self._closing.is_set():
            began = time.monotonic()
            try:
                self._exchange(began)
                pause = began + _PERIOD - time.monotonic()
            except Exception as error:  # A serial device also raises exceptions that are no OSError.
                self._client.close()
                self.status = self._measured = None
                self._sent, pause = b"", _AGAIN
                self._tell(f"does not answer at {self._where}", f", and is asked again every {_AGAIN:g} s")
                _logger.debug("%s gripper: %s", self._arm, error)
            self._closing.wait(max(pause, 0.0))
        self._client.close()

    def _exchange(self, now: float) -> None:
        """Write the request to the gripper if it has changed, and then read the gripper's status."""
        status, wanted, unit = self.status, self._wanted, self._config.unit
        if status is not None and wanted is not None and (request := self._request(status, wanted)) != self._sent:
            if request == _ACTIVATION:
                _logger.info("%s gripper: is activated, its fingers open and close", self._arm)
            _checked(self._client.write_registers(_OUTPUTS, list(struct.unpack(">3H", request)), device_id=unit))
            self._sent = request
        answer = _checked(self._client.read_input_registers(_INPUTS, count=3, device_id=unit))
        status = GripperStatus.of(answer.registers)
        self._used |= status.ready
        known = self._used and status.activated
        self._measured = (self._opening(status.position), now) if known else None
        self.status = status
        ended = self._used and not status.ready
        trouble = status.trouble or ("is not active any more" if ended else "")
        self._tell(trouble, "; the next run activates it" if ended else "")

    def _request(self, status: GripperStatus, wanted: float) -> bytes:
        """Return the values that the output registers of the gripper should have now."""
        if status.ready:
            speed, force = round(255 * self._config.speed), round(255 * self._config.force)
            return bytes((_ACTIVATE | _GO, 0, 0, self._position(wanted), speed, force))
        if self._used or self._sent == _ACTIVATION:
            return self._sent
        return _RESET if status.requested else _ACTIVATION

    def _position(self, opening: float) -> int:
        """Return the position to request for an opening. For 0 and 1, the fingers move as far as they can."""
        if opening in (0.0, 1.0):
            return 255 - round(255 * opening)
        opened, closed = self._config.counts
        return round(closed + opening * (opened - closed))

    def _opening(self, position: int) -> float:
        opened, closed = self._config.counts
        return min(max((closed - position) / (closed - opened), 0.0), 1.0)

    def _tell(self, trouble: str, detail: str) -> None:
        """Log a fault once, and its end once."""
        if trouble and trouble != self._told:
            _logger.warning("%s gripper: %s%s", self._arm, trouble, detail)
        elif self._told and not trouble:
            _logger.info("%s gripper: answers, and nothing is wrong with it", self._arm)
        self._told = trouble


def _client(arm: str, config: ModbusGripperConfig) -> Any:
    """Return a client, which connects at its first request."""
    try:
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient

        if config.endpoint is None:
            return ModbusSerialClient(config.modbus, baudrate=115200, timeout=_TIMEOUT, retries=_REPEATS)
    except (ImportError, RuntimeError) as error:  # Pymodbus raises RuntimeError if pyserial is missing.
        needs = f"needs pymodbus and pyserial: {install_line('modbus')}"
        raise ConfigError(f"fri.{arm}.gripper.modbus: {needs}") from error
    host, port = config.endpoint
    return ModbusTcpClient(host, port=port, timeout=_TIMEOUT, retries=_REPEATS)


def _checked(answer: Any) -> Any:
    if answer.isError():
        raise OSError(f"it refuses: {answer}")
    return answer
