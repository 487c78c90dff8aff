"""Many pages, and slow, hostile or frozen pages, do not change a run and do not let its loop wait."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array
from q2r2_control.viewer.web import view as view_module
from q2r2_control.viewer.web.exchange import PageChange, PageRequest, PageSetting
from q2r2_control.viewer.web.server import LimitedAnswers
from q2r2_control.viewer.web.view import PageView
from tests.pipeline.loops import pipeline

SECONDS = 1.5  # Duration of each run [s].
NOISE = np.random.default_rng(7)


@pytest.fixture
def view() -> Iterator[PageView]:
    with PageView("127.0.0.1", 0) as made:
        yield made


def joined(url: str) -> ClientConnection:
    host = urlsplit(url).netloc
    return connect(
        f"ws://{host}", origin=Origin(f"http://{host}"), subprotocols=[Subprotocol(f"viser-v{viser.__version__}")]
    )


def played(loop: Pipeline, acts: Mapping[float, Callable[[], object]]) -> Array:
    """Return the joint positions (ticks, nv) of a run in simulated time [rad].

    ``acts`` has the functions that are called during the run. Their keys are the times of the calls [s].
    """
    positions, due = [], sorted(acts)

    def follow(tick: Tick) -> None:
        positions.append(tick.reference.q)
        while due and tick.t >= due[0]:
            acts[due.pop(0)]()

    loop.listeners.append(follow)
    loop.run(SECONDS, realtime=False)
    assert not due
    return np.array(positions)


def circling() -> Pipeline:
    return pipeline(ScriptedInput("circle"))


def test_many_watchers_invalid_messages_and_a_frozen_page_process_do_not_change_the_run(
    view: PageView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_module, "_PERIOD", 0.0)  # More frames are sent than fit into a pipe.
    loop = circling()
    url = view.begin(loop, "hostile", False)
    page = view._process.pid
    with ExitStack() as stack:

        def crowd() -> None:
            for _ in range(10):  # These pages read nothing.
                stack.callback(joined(url).close)

        def garbage() -> None:
            hostile = joined(url)
            for content in (NOISE.bytes(1000), b"", "text", msgspec.msgpack.encode({"type": "Unknown"})):
                try:
                    hostile.send(content)
                except ConnectionClosed:
                    hostile = joined(url)
            hostile.close()
            with suppress(ConnectionClosed), joined(url) as large:
                large.send(bytes(1 << 21))

        def too_many() -> None:
            with suppress(InvalidStatus):
                for _ in range(8):
                    stack.callback(joined(url).close)

        acts = {0.3: crowd, 0.6: garbage, 0.8: too_many, 1.0: lambda: os.kill(page, signal.SIGSTOP)}
        try:
            watched = played(loop, acts)
        finally:
            os.kill(page, signal.SIGCONT)
    assert view._process.alive
    assert np.array_equal(watched, played(circling(), {}))


def test_a_slider_allows_no_speed_above_the_cells_speed_and_no_invalid_value(view: PageView) -> None:
    loop = circling()
    view.begin(loop, "sliders", False)
    usual = loop.config.control.max_linear_speed
    values = [0.5, np.nan, -1.0, 0.0, 0.5, np.inf, 0.5, 1e9]
    seen: list[tuple[float, float]] = []

    def act(value: float) -> None:
        seen.append((loop.controller.settings.max_linear_speed / usual, loop.teleop.settings.position_scale))
        for setting in PageSetting:
            view._on_answer(PageChange(setting, value))

    played(loop, {0.1 * (1 + i): partial(act, value) for i, value in enumerate([*values, 1.0])})
    assert seen == [(1.0, 1.0), *[(0.5, 0.5)] * 5, (1.0, 0.5), (0.5, 0.5), (1.0, 0.5)]


def test_a_flood_of_requests_is_thinned_out_but_a_request_to_stop_always_passes() -> None:
    passed: list[object] = []
    answer = LimitedAnswers(passed.append, clock=lambda: 0.0)
    for _ in range(1000):
        answer(PageRequest.HOME)
    answer(PageRequest.STOP)
    assert 0 < passed.count(PageRequest.HOME) < 100
    assert passed[-1] is PageRequest.STOP
