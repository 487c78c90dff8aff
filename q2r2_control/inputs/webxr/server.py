"""The process that serves the page and its socket on one port. It decides which page drives, and passes data on."""

from __future__ import annotations

import asyncio
import http
import json
import logging
import time
from collections.abc import Callable, Iterator
from importlib.resources import files
from ipaddress import ip_address
from threading import Thread
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.connections import TURN
from q2r2_control.inputs.listener import (
    MAX_HOSTS_NAMED,
    HostLog,
    is_allowed,
    verdicts,
    written,
)
from q2r2_control.inputs.page_door import PageDoor, protect, text_response
from q2r2_control.inputs.webxr.exchange import (
    Admitted,
    CameraPicture,
    HeadsetPageSetup,
    Listening,
    Logged,
    Lost,
    Received,
    Requested,
    Shown,
)
from q2r2_control.inputs.webxr.page_client import MAX_MESSAGES_PER_SECOND, PageClient
from q2r2_control.inputs.webxr.page_messages import LONGEST, HeadsetRequest, read
from q2r2_control.types import HapticFeedback

# Codes that tell a page why its socket is closed. FREE goes to pages that only watch. It says that no page drives any
# more, so that one of them may now drive.
REFUSED, DROPPED, OVER, FREE = 4001, 4002, 4003, 4004
_MOST_WATCHERS = 8  # Greatest number of pages that only watch.
_WATCHED = 0.1  # Least time between two states that are sent to pages that watch [s].
_MOST_SOCKETS = 16  # Greatest number of open pages.
_KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
_POLICY = "default-src 'self'; connect-src 'self'; style-src 'self'; img-src 'self' blob: data:; base-uri 'none'"


class PageServer:
    """Serves pages, and decides which page drives by the same rules as the TCP server does for headsets."""

    def __init__(self, setup: HeadsetPageSetup, door: PageDoor, answer: Callable[[Any], None]) -> None:
        self._setup, self._door, self._answer = setup, door, answer
        self._clock = time.monotonic
        self._log = HostLog(_logger_of(answer))
        self._driver: PageClient | None = None
        self._waiting: list[PageClient] = []
        self._watchers: list[PageClient] = []  # Pages that never drive.
        self._watched = 0.0  # When the last state was sent to pages that watch [s].
        self._sockets = 0  # Number of open sockets.
        folder = files(__package__).joinpath("page")
        self._files = {file.name: file.read_text(encoding="utf-8") for file in folder.iterdir() if file.is_file()}
        self._scene = json.dumps({"scene": setup.display.scene()}) if setup.display is not None else None

    async def run(self, requests: Iterator[Any]) -> None:
        """Serve until ``requests`` ends, because the run has closed its end of the connection to this process."""
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def pass_on() -> None:
            for request in requests:
                loop.call_soon_threadsafe(self._take, request)
            loop.call_soon_threadsafe(ended.set)

        quiet = logging.getLogger("q2r2_control.inputs.webxr.sockets")
        quiet.addHandler(logging.NullHandler())
        quiet.propagate = False
        async with serve(
            self._serve,
            sock=self._door.socket,
            ssl=self._door.tls,
            process_request=self._answer_request,
            max_size=LONGEST,
            compression=None,
            ping_interval=None,
            close_timeout=1.0,
            open_timeout=5.0,
            logger=quiet,
        ):
            self._answer(Listening(self._door.port, self._door.urls))
            Thread(target=pass_on, daemon=True).start()
            watch = asyncio.create_task(self._watch())
            await ended.wait()
            watch.cancel()
            pages = self._pages
            for client in pages:
                client.end(OVER, "the run is over")
            await asyncio.gather(*(client.closing for client in pages if client.closing is not None))

    @property
    def _pages(self) -> list[PageClient]:
        return [*([] if self._driver is None else [self._driver]), *self._waiting, *self._watchers]

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a file of the page or a refusal; None if a socket may be opened."""
        path = urlsplit(request.path).path
        name = path.removeprefix("/") or "index.html"
        is_socket = path == "/socket"
        host, _ = _peer_of(connection)
        if not is_allowed(host, self._setup.allow):
            return text_response(http.HTTPStatus.FORBIDDEN, f"{host} is not in headset.allow\n")
        # The other files of the page are no secret, since they are in the public package.
        reason = self._door.refusal(request, with_token=is_socket or name == "index.html")
        if reason is None and is_socket and self._sockets >= _MOST_SOCKETS:
            reason = f"{_MOST_SOCKETS} pages are open"
        if reason is not None:
            self._log.write(host, logging.WARNING, f"page {host} refused: {reason}", self._clock())
            return text_response(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
        if is_socket:
            return None
        if name not in self._files:
            return text_response(http.HTTPStatus.NOT_FOUND, "no such file\n")
        response = text_response(http.HTTPStatus.OK, self._files[name], _KINDS[f".{name.rpartition('.')[2]}"])
        protect(response, _POLICY)
        return response

    async def _serve(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        query = parse_qs(urlsplit(connection.request.path).query)
        page, watches = query.get("page", [""])[0][:64], "watch" in query
        host, peer = _peer_of(connection)
        client = PageClient(connection, host, peer, page, self._clock())
        self._sockets += 1
        if watches:
            self._watch_with(client)
        else:
            self._waiting.append(client)
        self._settle(client.since)
        sending = asyncio.create_task(client.send_newest(self._scene, self._setup.display))
        reason = "closed by the page"
        try:
            async for message in connection:
                self._receive(client, message)
        except ProtocolError as error:
            reason = " ".join(str(error).split())
            client.end(DROPPED, reason)
        except ConnectionClosed as error:
            reason = f"connection lost: {error}"
        finally:
            self._sockets -= 1
            sending.cancel()
            self._forget(client, client.reason or reason)
            if client.closing is not None:
                await client.closing  # Without this wait, the page would not get the reason why its socket is closed.

    def _receive(self, client: PageClient, text: str | bytes) -> None:
        now = self._clock()
        if not client.rate.take(now):
            raise ProtocolError(f"more than {MAX_MESSAGES_PER_SECOND} messages in a second")
        message = read(text)
        client.last_frame, client.acknowledged = now, message.seq
        self._ask(client, message.request)
        if client in self._watchers:
            return
        if message.hands:
            client.last_pose = now
        if client is not self._driver:
            self._settle(now)
            return
        # If several messages come together, only the newest one and the last one before each change of the buttons are
        # passed on.
        if client.newest is None:
            asyncio.get_running_loop().call_soon(self._pass_on, client)
        elif client.newest.controls != message.controls:
            self._pass_on(client)
        client.newest = message

    def _ask(self, client: PageClient, request: HeadsetRequest | None) -> None:
        """Pass on the request of a button: a stop from any page, other requests only from the page that drives."""
        if request is HeadsetRequest.STOP or (request is not None and client is self._driver):
            self._answer(Requested(request))

    def _watch_with(self, client: PageClient) -> None:
        """Show the run to a page that only watches. This is possible only while another page drives."""
        if self._driver is None or len(self._watchers) >= _MOST_WATCHERS:
            reason = "nobody drives" if self._driver is None else f"{_MOST_WATCHERS} pages watch"
            client.end(FREE if self._driver is None else REFUSED, reason)
        else:
            self._watchers.append(client)
            client.driver = self._driver.peer
            client.due.set()

    def _pass_on(self, client: PageClient) -> None:
        message, client.newest = client.newest, None
        if message is not None and client is self._driver:
            self._answer(Received(message.receptions()))
            client.due.set()

    def _take(self, request: Any) -> None:
        """Take data from the run: vibrations, states and pictures for the driver, and states for pages that watch."""
        driver = self._driver
        if driver is None:
            return
        match request:
            case HapticFeedback():
                driver.vibrations[request.hand] = request
            case Shown():
                driver.shown = request.content
                if self._clock() >= self._watched + _WATCHED:
                    self._watched = self._clock()
                    for client in self._watchers:
                        client.shown = request.content
                        client.due.set()
            case CameraPicture():
                driver.picture = request.jpeg
                return  # The picture is sent later, with the next data that are due.
        driver.due.set()

    async def _watch(self) -> None:
        """Drop a driver that is silent, and decide about the pages that wait. This is done every ``TURN``."""
        while True:
            # As in the TCP server, all data that were sent before this time are read before the decisions about pages.
            asked = self._clock()
            await asyncio.sleep(TURN)
            driver = self._driver
            if driver is not None and asked - driver.last_frame > self._setup.silence:
                self._drop(driver, f"no message for {self._setup.silence:g} s")
            self._settle(asked)
            self._log.flush(self._clock())

    def _settle(self, now: float) -> None:
        """Decide which page drives."""
        for client, admitted, reason in verdicts(self._waiting, lambda: self._driver, now):
            driver = self._driver
            if admitted:
                if driver is not None:
                    self._drop(driver, reason)
                self._waiting.remove(client)
                self._driver = client
                self._answer(Admitted(client.peer))
                self._write(client, logging.INFO, "connected")
            elif driver is not None:
                self._waiting.remove(client)
                if client.host not in driver.refused_hosts and len(driver.refused_hosts) < MAX_HOSTS_NAMED:
                    driver.refused_hosts.add(client.host)
                    self._write(client, logging.WARNING, f"refused: {reason}")
                client.end(REFUSED, reason)

    def _drop(self, client: PageClient, reason: str) -> None:
        client.end(DROPPED, reason)
        self._forget(client, reason)

    def _forget(self, client: PageClient, reason: str) -> None:
        """Remove a page whose connection has ended, or that may not drive any more. Repeated calls do nothing."""
        for pages in (self._waiting, self._watchers):
            if client in pages:
                pages.remove(client)
        if client is self._driver:
            self._driver = None
            for watcher in self._watchers:
                watcher.end(FREE, "nobody drives")
            self._answer(Lost(reason))
            self._write(client, logging.WARNING if client.reason else logging.INFO, f"gone: {reason}")

    def _write(self, client: PageClient, level: int, what: str) -> None:
        self._log.write(client.host, level, f"page {client.peer} {what}", self._clock())


def _logger_of(answer: Callable[[Any], None]) -> logging.Logger:
    """Return a logger that sends its lines to the run."""

    class Answering(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            answer(Logged(record.levelno, record.getMessage()))

    logger = logging.Logger(__name__, logging.INFO)
    logger.addHandler(Answering())
    return logger


def _peer_of(connection: ServerConnection) -> tuple[str, str]:
    """Return the host of a page; and its host and port as one text for people.

    The host of an IPv4 connection through an IPv6 socket is an IPv4 address.
    """
    address, port = connection.remote_address[:2]
    host = str(getattr(ip_address(address), "ipv4_mapped", None) or address)
    return host, written(host, port)


def main(requests: Iterator[Any], answer: Callable[[Any], None]) -> None:
    """Run the process. It answers with :class:`Listening`, and then with the data of the page that drives.

    Args:
        requests: The data from the run. The first one is the setup.
        answer: Sends data to the run.

    Raises:
        ConfigError: If the address cannot be bound, or if the certificate cannot be used.
    """
    setup: HeadsetPageSetup | None = next(requests, None)
    if setup is not None:
        door = PageDoor(setup.host, setup.port, "--input webxr", setup.token, setup.certificate, setup.addresses)
        asyncio.run(PageServer(setup, door, answer).run(requests))
