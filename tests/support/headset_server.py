"""A headset server under test with a simulated clock, and helpers that use it from outside."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.types import HandSample
from tests.support.fake_headset import FakeHeadset

IDENTITY = (0.0, 0.0, 0.0, -1.0)
A_LINE_LATER = 1.0  # Shortest time between two lines in the log about the same host [s].


class HandClock:
    """A clock that only the test advances."""

    def __init__(self) -> None:
        self.now = 100.0
        self._readings = 0

    def __call__(self) -> float:
        self._readings += 1
        return self.now

    def advance(self, seconds: float) -> None:
        """Advance the clock. Return when the server's thread has begun to wait for the network at the new time.

        The thread reads the clock before and after each wait. After three readings, a wait has begun at the new time.
        """
        self.now += seconds
        read = self._readings
        eventually(lambda: self._readings >= read + 3, "the server looks at its clock")


@contextmanager
def running(server: HeadsetServer) -> Iterator[HeadsetServer]:
    server.start()
    try:
        yield server
    finally:
        server.close()


def eventually(condition: Callable[[], object], what: str = "") -> None:
    """Wait until ``condition`` holds. The timeout is far longer than the other thread needs."""
    deadline = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < deadline, f"never happened: {what or condition}"
        time.sleep(0.001)


def collect(server: HeadsetServer, count: int) -> list[HandSample]:
    """Poll like the loop until ``count`` samples have come."""
    samples: list[HandSample] = []

    def enough() -> bool:
        samples.extend(server.poll(0.0))
        return len(samples) >= count

    eventually(enough, f"{count} samples")
    return samples


def assert_serves(server: HeadsetServer, dialect: str = "ros2") -> None:
    """Assert that a new headset is accepted and that its motion arrives."""
    with connect(server, dialect) as headset:
        headset.send(headset.registrations() + headset.pose("right", (7.0, 8.0, 9.0), IDENTITY))
        headset.read_until("__topic_list")
        (sample,) = collect(server, 1)
        assert (sample.hand, sample.position.tolist()) == ("right", [7.0, 8.0, 9.0])
    eventually(lambda: server.statistics.peer is None)


def connect(server: HeadsetServer, dialect: str = "ros2", source: str = "") -> FakeHeadset:
    """Connect, and wait until the server has the connection, so that the order of events is fixed."""
    headset = FakeHeadset(server.address, dialect, source=source)
    headset.read_until("__handshake")
    return headset


def registered(server: HeadsetServer, dialect: str = "ros2", source: str = "") -> FakeHeadset:
    """Connect a headset that has registered its topics."""
    headset = connect(server, dialect, source)
    headset.send(headset.registrations())
    headset.read_until("__topic_list")
    return headset


def next_topic(headset: FakeHeadset) -> str:
    """Return the topic of the next frame from the server."""
    frame = headset.read_frame()
    assert frame is not None
    return frame[0]


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return warnings and errors of this package. Warnings of libraries are left out, because they depend on timing."""
    own = (record for record in caplog.records if record.name.startswith("q2r2_control"))
    return [record.getMessage() for record in own if record.levelno >= logging.WARNING]


def wait_until_dropped(server: HeadsetServer, headset: FakeHeadset) -> None:
    eventually(lambda: server.statistics.peer is None, "the client is dropped")
    while headset.read_frame() is not None:
        pass
