"""Read each device in a thread of its own, because the loop that polls an input must never wait for a device."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from threading import Event, Thread
from typing import Any, Generic, Protocol, TypeVar

from q2r2_control import HandSample, HapticFeedback, InputError, Q2R2Error

Reading = TypeVar("Reading", covariant=True)
Say = Callable[[str], None]
tell: Say = logging.getLogger(__name__).info

READ_TIMEOUT = 0.1  # Longest time for which ``Device.read`` waits [s].
_RETRY = 1.0  # Time between two attempts to open a device again [s].
# Number of successive reads that may fail. Buses of hobby servos lose single answers. A hand without a new pose moves
# no arm, and after ``teleop.gate.timeout`` its arm stops, so it is safe to wait for further reads.
_FAILURES = 5


class Device(Protocol[Reading]):
    """A device. Only its own thread calls these methods, and any of them may raise any exception.

    The line about an exception begins with the reader's name, so the exception's message need not tell which device it
    is.
    """

    def open(self) -> str:
        """Open the device, and return its name for the log."""

    def read(self) -> Reading | None:
        """Return the next reading. Wait at most about :data:`READ_TIMEOUT`, and return None if none has come."""

    def close(self) -> None:
        """Close the device, which may be closed or unplugged already."""


class DeviceReader(Generic[Reading]):
    """Reads one device, and opens it again after it was lost. Each line that it reports begins with ``name``."""

    def __init__(self, name: str, device: Device[Reading], say: Say = tell) -> None:
        self.connected = False
        self._name, self._device, self._say = name, device, say
        self._readings: deque[Reading | None] = deque(maxlen=1000)
        self._stop, self._tried = Event(), Event()
        self._fault: Exception | None = None  # Why the device could not be opened at the start; None if it was.
        self._thread: Thread | None = None

    def start(self) -> None:
        """Open the device.

        Raises:
            InputError: If it cannot be opened.
        """
        self._stop.clear()
        self._tried.clear()
        self._fault, self._thread = None, Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()
        self._tried.wait()
        if self._fault is not None:
            raise InputError(f"{self._name}: {_words(self._fault)}") from self._fault

    def take(self) -> list[Reading | None]:
        """Return the readings since the previous call, oldest first. None stands for a loss of the device."""
        return [self._readings.popleft() for _ in range(len(self._readings))]

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                opened = self._device.open()
            except Exception as error:
                self._close_device()
                if not self._tried.is_set():
                    self._fault = error
                    self._tried.set()
                    return
            else:
                self._say(f"{self._name}: {opened} is connected")
                self.connected = True
                self._tried.set()
                self._read_until_lost()
                self.connected = False
                self._readings.append(None)
                self._close_device()
            self._stop.wait(_RETRY)

    def _read_until_lost(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                reading = self._device.read()
            except Exception as error:
                failures += 1
                if failures < _FAILURES:
                    continue
                self._say(f"{self._name}: lost, {_words(error)}; it is opened again as soon as it is there")
                return
            failures = 0
            if reading is not None:
                self._readings.append(reading)

    def _close_device(self) -> None:
        with suppress(Exception):  # Closing an unplugged device can raise an exception.
            self._device.close()


def _words(error: Exception) -> str:
    """Return an exception's message in one line."""
    return " ".join(str(error).split()) or type(error).__name__


class DeviceInput:
    """The base class of inputs that read devices. It opens, reads and closes all its devices together."""

    options = ("say",)
    feels = False

    def __init__(self, readers: Mapping[str, DeviceReader[Any]]) -> None:
        self._readers = readers

    @property
    def connected(self) -> bool:
        """Whether all devices are connected."""
        return all(reader.connected for reader in self._readers.values())

    def start(self) -> None:
        """Open all devices.

        Raises:
            Q2R2Error: If a device cannot be opened. All others are closed again.
        """
        try:
            for reader in self._readers.values():
                reader.start()
        except Q2R2Error:
            self.close()
            raise

    def samples_of(self, hands: Mapping[str, Any], now: float) -> list[HandSample]:
        """Return the samples of all hands at ``now`` [s]. ``hands`` are the RateHand or LeaderHand of each reader."""
        polled = (its.poll(self._readers[hand].take(), now) for hand, its in hands.items())
        return [sample for samples in polled for sample in samples]

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Do nothing, because none of these devices vibrates."""

    def close(self) -> None:
        for reader in self._readers.values():
            reader.close()
