"""A running headset server for tests of what comes over the network."""

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
    """A running server whose time stands still unless the test moves it, so that no slow machine makes a timeout."""
    with running(HeadsetServer(port=0, clock=clock)) as server:
        yield server
