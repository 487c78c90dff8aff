"""A page that is connected, and the data that still have to be sent to it."""

from __future__ import annotations

import asyncio
import json
from contextlib import suppress
from typing import Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from q2r2_control.inputs.listener import Peer, RateLimit
from q2r2_control.inputs.webxr.exchange import Display
from q2r2_control.inputs.webxr.page_messages import PageMessage
from q2r2_control.inputs.webxr.shown import FromRun, ShownVibration
from q2r2_control.types import HapticFeedback

MAX_MESSAGES_PER_SECOND = 300  # A page that sends more messages is dropped. Headsets send up to 120 per second.

_LONGEST_REASON = 120  # Greatest length of the reason for which a socket is closed [bytes].


class PageClient(Peer):
    """A page that is connected. It may drive, wait or only watch."""

    def __init__(self, connection: ServerConnection, host: str, peer: str, page: str, now: float) -> None:
        # A page keeps its number ``page`` when it is reloaded. The number takes the place of the topics that a
        # headset's app registers. Equal registrations show that a new connection is from the same client as an earlier
        # connection.
        super().__init__(peer, host, since=now, last_frame=now, registrations=({"page": page} if page else {}, {}))
        self.connection = connection
        self.newest: PageMessage | None = None  # The newest message; None if it has been passed on.
        self.acknowledged = -1  # Number of the newest message that was received; -1 before the first one.
        self.refused_hosts: set[str] = set()  # Hosts that the log has named as refused while this page drives.
        self.due = asyncio.Event()  # Set if something has to be sent.
        self.vibrations: dict[str, HapticFeedback] = {}  # The newest vibration of each hand that is not sent yet.
        self.shown: Any = None  # The newest state of the run; None if it has been sent.
        self.picture: bytes | None = None  # The newest picture of a camera; None if it has been sent.
        # Address of the page that drives, which a page that watches has to be told; None if it has been told.
        self.driver: str | None = None
        self.rate = RateLimit(MAX_MESSAGES_PER_SECOND)
        self.reason = ""  # Why the server has closed the socket; empty if it has not.
        self.closing: asyncio.Future[None] | None = None

    def end(self, code: int, reason: str) -> None:
        """Begin to close the socket. It is closed when the page has answered."""
        self.reason = reason
        shown = reason.encode()[:_LONGEST_REASON].decode(errors="ignore")
        self.closing = asyncio.ensure_future(self.connection.close(code, shown))

    async def send_newest(self, scene: str | None, display: Display | None) -> None:
        """Send the ``scene`` first, and then the newest data each time ``due`` is set. Older data are left out."""
        connection = self.connection
        with suppress(ConnectionClosed):
            if scene is not None:
                await connection.send(scene)
            while True:
                await self.due.wait()
                self.due.clear()
                vibrations, self.vibrations = self.vibrations, {}
                driver, self.driver = self.driver, None
                shown, self.shown = self.shown, None
                if driver is not None:
                    await self._tell({"driver": driver})
                for vibration in vibrations.values():
                    hand, frequency, amplitude = vibration.hand, vibration.frequency, vibration.amplitude
                    shown_vibration = ShownVibration(hand=hand, frequency=frequency, amplitude=amplitude)
                    await self._tell({"vibration": shown_vibration})
                if shown is not None and display is not None:
                    await self._tell({"state": display.message(shown), "acknowledged": self.acknowledged})
                if self.picture is not None and not connection.transport.get_write_buffer_size():
                    picture, self.picture = self.picture, None
                    await connection.send(picture)

    async def _tell(self, message: FromRun) -> None:
        await self.connection.send(json.dumps(message))
