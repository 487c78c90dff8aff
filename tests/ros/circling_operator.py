"""An operator's headset: both hands move in circles, on a TCP connection that is renewed when it is lost."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from tests.support.fake_headset import RATE_HZ, FakeHeadset, Sensor
from tests.support.operator_script import HANDS, START, Vector

RADIUS, SPEED = 0.08, 0.3  # of the hands' circles [m], [m/s]
RIGHT_SHARE = 0.9  # of the right hand's circle, since human hands never move as one
RAMP = 0.3  # from rest to that speed [s]
PRESS = 0.2  # longer than a chord's window [s]


class Operator:
    """Streams both hands while :meth:`streaming` and ``online``; they circle while ``moves``. Tests set both."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.online = True
        self.moves = False
        self._lower: frozenset[str] = frozenset()
        self._sent = 0  # samples since that has changed
        self._address = address
        self._angle = self._rate = 0.0
        self._angles: deque[tuple[float, float]] = deque(maxlen=int(60.0 * RATE_HZ))  # when [s], and the angle
        self._ended = threading.Event()
        self._sensor = Sensor()

    @contextmanager
    def streaming(self) -> Iterator[Operator]:
        """Connect, as often as necessary, and stream."""
        thread = threading.Thread(target=self._run, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._ended.set()
            thread.join()

    def press(self, *hands: str) -> None:
        """The lower buttons of these hands, which engage and pause."""
        for held in (frozenset(hands), frozenset[str]()):
            self._lower, self._sent = held, 0
            time.sleep(PRESS)
            while self._sent <= 3:  # this program may have had no processor
                time.sleep(0.01)

    def rest(self, at: float | None = None) -> None:
        """Put both hands at rest where they were at that time [s], or at the start; no arm may follow meanwhile."""
        self.moves = False
        self._rate = 0.0
        self._angle = next((angle for t, angle in reversed(list(self._angles)) if t <= (at or -1.0)), 0.0)

    def _run(self) -> None:
        while not self._ended.wait(0.1):
            if not self.online:
                continue
            # The server may not listen yet, or have ended.
            with suppress(OSError), FakeHeadset(self._address, connect_timeout=0.0) as headset:
                headset.send(headset.registrations())
                self._stream(headset)

    def _stream(self, headset: FakeHeadset) -> None:
        while self.online and not self._ended.wait(1.0 / RATE_HZ):
            self._move(1.0 / RATE_HZ)
            headset.discard_received()
            for hand in HANDS:
                headset.send(headset.pose(hand, self._position(hand), (0.0, 0.0, 0.0, 1.0)))
                headset.send(headset.inputs(hand, lower=hand in self._lower))
            self._sent += 1

    def _move(self, dt: float) -> None:
        full = SPEED / RADIUS
        change = dt / RAMP * full
        self._rate = min(self._rate + change, full) if self.moves else max(self._rate - change, 0.0)
        self._angle += self._rate * dt
        self._angles.append((time.monotonic(), self._angle))

    def _position(self, hand: str) -> Vector:
        x, y, z = START[hand]
        radius = RADIUS if hand == "left" else RIGHT_SHARE * RADIUS
        position = x, y + radius * math.sin(self._angle), z + radius * (1.0 - math.cos(self._angle))
        return self._sensor.measured(position)
