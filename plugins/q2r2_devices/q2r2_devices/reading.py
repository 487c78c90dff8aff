"""Read each device in a thread of its own, because the loop that polls an input must never wait for a device."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from threading import Event, Thread
from typing import Any, Generic, Protocol, TypeVar

from q2r2_control import HandSample, HapticFeedback, InputError

Reading = TypeVar("Reading", covariant=True)
Say = Callable[[str], None]
tell: Say = logging.getLogger(__name__).info

READ_TIMEOUT = 0.1  # Longest time for which ``Device.read`` waits [s].
_RETRY = 1.0  # Time between two attempts to open a device again [s].
# Number of successive reads that may fail. Buses of hobby servos lose single answers. A hand without a new pose moves
# no arm, and after ``teleop.gate.timeout`` its arm stops, so it is safe to wait for further reads.
_FAILURES = 5
# If a read of a device lasts longer than _LONGEST_READ [s], the device counts as lost. Without this limit, no arm would
# stop if a serial port or a library waits for ever. Of the time between two polls of the input at most _LONGEST_POLL
# [s] count, so that a pause of the loop is no fault of the device.
_LONGEST_READ, _LONGEST_POLL = 1.0, 0.1
_LONGEST_CLOSE = 2.0  # Longest time to wait at the end of a run for a device that does not answer [s].


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
        self._name, self._device, self._say = name, device, say
        self._readings: deque[Reading | None] = deque(maxlen=1000)
        self._stop, self._tried = Event(), Event()
        self._fault: Exception | None = None  # Why the device could not be opened at the start; None if it was.
        self._thread: Thread | None = None
        self._is_open = self._is_stuck = False
        self._reads = 0  # Number of reads that have begun.
        # The number of reads at the last call of ``take``, the time of this call [s], and how long this read lasts [s].
        self._seen, self._looked, self._lasts = 0, 0.0, 0.0

    @property
    def connected(self) -> bool:
        """Whether the device is open, and answered when :meth:`take` was called last."""
        return self._is_open and not self._is_stuck

    def start(self) -> None:
        """Open the device.

        Raises:
            InputError: If it cannot be opened, or if a read of the last run has not ended yet.
        """
        if self._thread is not None and self._thread.is_alive():
            raise InputError(
                f"{self._name}: the device has not answered since the last run; allowed: after it was plugged in anew"
            )
        # The thread has an event of its own, because a thread that does not end must not see the next start.
        self._stop = Event()
        self._tried.clear()
        self._is_stuck = False
        self._readings.clear()
        self._readings.append(None)  # What the device did in the last run no longer counts.
        self._fault = None
        self._thread = Thread(target=self._run, args=(self._stop,), name=self._name, daemon=True)
        self._thread.start()
        self._tried.wait()
        if self._fault is not None:
            raise InputError(f"{self._name}: {_words(self._fault)}") from self._fault

    def take(self) -> list[Reading | None]:
        """Return the readings since the previous call, oldest first. None stands for a loss of the device.

        A device that does not answer counts as lost until it answers. This method never waits.
        """
        self._look()
        readings = [self._readings.popleft() for _ in range(len(self._readings))]
        return [*readings, None] if self._is_stuck else readings

    def close(self) -> None:
        """Close the device. If it does not answer, it stays open, and its thread ends with this program."""
        if self._thread is None or self._stop.is_set():
            return
        self._stop.set()
        self._thread.join(_LONGEST_CLOSE)
        if self._thread.is_alive():
            self._say(f"{self._name}: does not answer, so it could not be closed")

    def _look(self) -> None:
        """Find out whether the device has been in the same read for too long."""
        now, reads, was_stuck = time.monotonic(), self._reads, self._is_stuck
        passed, self._looked = min(now - self._looked, _LONGEST_POLL), now
        self._lasts = self._lasts + passed if reads == self._seen and self._is_open else 0.0
        self._seen = reads
        self._is_stuck = self._lasts > _LONGEST_READ
        if self._is_stuck and not was_stuck:
            self._say(f"{self._name}: lost, no answer for {_LONGEST_READ:g} s; it counts again as soon as it answers")
        elif was_stuck and self.connected:
            self._say(f"{self._name}: answers again")

    def _run(self, stop: Event) -> None:
        while not stop.is_set():
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
                self._is_open = True
                self._tried.set()
                self._read_until_lost(stop)
                self._is_open = False
                self._readings.append(None)
                self._close_device()
            stop.wait(_RETRY)

    def _read_until_lost(self, stop: Event) -> None:
        failures = 0
        while not stop.is_set():
            self._reads += 1
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
            InputError: If a device cannot be opened. All others are closed again.
        """
        try:
            for reader in self._readers.values():
                reader.start()
        except BaseException:  # Ctrl-C may come while a device is opened, which can take seconds.
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
