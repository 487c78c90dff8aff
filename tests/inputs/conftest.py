"""A running headset server for tests of network input."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from q2r2_control.inputs.headset import HeadsetServer
from tests.support.headset_server import HandClock, running


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


@pytest.fixture
def server(clock: HandClock) -> Iterator[HeadsetServer]:
    """Return a running server. Only the test advances its clock, so that a slow machine causes no timeout."""
    with running(HeadsetServer(port=0, clock=clock)) as server:
        yield server
