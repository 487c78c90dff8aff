"""The process that serves the page."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from threading import Condition, Lock, Thread
from typing import Any

import viser

from q2r2_control.viewer.web.door import Door
from q2r2_control.viewer.web.driving import Driving
from q2r2_control.viewer.web.exchange import Frame, PageLost, PageRequest, PageSetup, PageWatched, Ready
from q2r2_control.viewer.web.message_buffer import use_message_buffer
from q2r2_control.viewer.web.panel import Panel
from q2r2_control.viewer.web.scene import CellScene

_NICENESS = 10  # The process gets a low priority, since the loop comes first.
_LAST_WORDS = 0.5  # Time in which browsers are told that the run is over, before their connections are closed [s].
# Number of answers that are allowed per second, and number that may come in one burst. A page that moves two hands
# sends 220 answers per second.
_RATE, _BURST = 500.0, 50.0


class _Newest:
    """Passes only the newest frame from one thread to another."""

    def __init__(self) -> None:
        self._condition = Condition()
        self._frame: Frame | None = None
        self._ended = False

    def put(self, frame: Frame | None) -> None:
        """Pass a frame on. A ``frame`` of None says that no more frames follow."""
        with self._condition:
            self._frame, self._ended = frame, frame is None
            self._condition.notify()

    def __iter__(self) -> Iterator[Frame]:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._frame is not None or self._ended)
                frame, self._frame = self._frame, None
            if frame is None:
                return
            yield frame


class LimitedAnswers:
    """Passes answers of browsers on at a limited rate, because too many answers would delay the loop.

    A stop and the loss of a page that drove are always passed on.
    """

    def __init__(self, answer: Callable[[Any], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._answer, self._clock, self._lock = answer, clock, Lock()
        self._allowed, self._then = _BURST, clock()  # Number of answers that were allowed at a time, and this time [s].

    def __call__(self, answer: Any) -> None:
        with self._lock:
            now = self._clock()
            self._allowed, self._then = min(self._allowed + _RATE * (now - self._then), _BURST), now
            if self._allowed < 1.0 and answer is not PageRequest.STOP and not isinstance(answer, PageLost):
                return
            self._allowed = max(self._allowed - 1.0, 0.0)
        self._answer(answer)


def main(requests: Iterator[Any], answer: Callable[[Any], None]) -> None:
    """Run the process. It sends :class:`Ready` when the page is served, and then passes on what browsers ask for.

    Args:
        requests: The messages from the run: first the setup, then the frames. When they end, the run is over.
        answer: Sends data to the run.

    Raises:
        ConfigError: If the address is in use.
    """
    setup: PageSetup | None = next(requests, None)
    if setup is None:
        return
    with suppress(OSError):
        os.nice(_NICENESS)
    door, newest = Door(setup.host, setup.port, setup.certificate, setup.addresses), _Newest()
    use_message_buffer()
    with door.guards(setup.config.name):
        server = viser.ViserServer(host=setup.host, port=door.port, verbose=False)
    open_pages: set[int] = set()

    async def count(client: viser.ClientHandle, change: Callable[[int], None]) -> None:
        change(client.client_id)
        answer(PageWatched(len(open_pages)))

    server.on_client_connect(partial(count, change=open_pages.add))
    server.on_client_disconnect(partial(count, change=open_pages.discard))
    scene = CellScene(server, setup)
    limited = LimitedAnswers(answer)
    driving = Driving(server, setup, limited) if setup.driven else None
    panel = Panel(server, setup, driving, limited, door.messages.take_over)
    door.messages.watch(server.gui)
    answer(Ready(door.urls))

    def read() -> None:
        for frame in requests:
            panel.follow(frame)
            if driving is not None:
                driving.follow(frame)
            newest.put(frame)
        newest.put(None)

    Thread(target=read, daemon=True).start()
    for frame in newest:
        with server.atomic():
            scene.show(frame)
            panel.show(frame)
        if driving is not None:
            driving.show(frame)
    panel.end()
    server.flush()
    time.sleep(_LAST_WORDS)
    server.stop()
