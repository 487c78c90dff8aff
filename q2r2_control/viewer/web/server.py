"""The process that serves the page."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from threading import Condition, Thread
from typing import Any

import viser

from q2r2_control.viewer.web.door import Door
from q2r2_control.viewer.web.driving import Driving
from q2r2_control.viewer.web.exchange import Frame, PageSetup, Ready
from q2r2_control.viewer.web.panel import Panel
from q2r2_control.viewer.web.scene import CellScene

_NICENESS = 10  # the loop goes first


class _Newest:
    """Hands frames from one thread to another, the newest only."""

    def __init__(self) -> None:
        self._condition = Condition()
        self._frame: Frame | None = None
        self._ended = False

    def put(self, frame: Frame | None) -> None:
        """None: there are no more."""
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


def main(requests: Iterator[Any], answer: Callable[[Any], None]) -> None:
    """Answer :class:`Ready`, then what browsers ask for. Raises :class:`ConfigError` for an address that is taken."""
    setup: PageSetup | None = next(requests, None)
    if setup is None:
        return
    with suppress(OSError):
        os.nice(_NICENESS)
    door, newest = Door(setup.host, setup.port), _Newest()
    with door.guards():
        server = viser.ViserServer(host=setup.host, port=door.port, verbose=False)
    scene = CellScene(server, setup)
    driving = Driving(server, setup, answer) if setup.driven else None
    panel = Panel(server, setup, driving, answer)
    answer(Ready(door.url))

    def read() -> None:
        for frame in requests:
            panel.follow(frame)
            newest.put(frame)
        newest.put(None)

    Thread(target=read, daemon=True).start()
    for frame in newest:
        with server.atomic():
            scene.show(frame)
            panel.show(frame)
        if driving is not None:
            driving.show(frame)
    server.stop()
