"""A stand-in for the page in a headset: it sends messages to the server of a run, and reads the answers."""

from __future__ import annotations

import json
import ssl
from collections.abc import Callable
from contextlib import closing, suppress
from http.client import HTTPConnection, HTTPSConnection
from typing import Any
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.types import HandSample
from tests.support.processes import wait_until

Listen = Callable[..., WebXrInput]
AT_REST = (0.0, 0.0, 0.0, 1.0)


def hand(x: float, *buttons: bool, **more: Any) -> dict[str, Any]:
    pressed = [*buttons, False, False, False][:3]
    return {"pose": [x, 0.0, 1.0, *AT_REST], "buttons": pressed, "axes": [0.0] * 4} | more


class Page:
    """The connection of a page to the server. It numbers its messages; ``number`` is the number of the page itself."""

    def __init__(self, source: WebXrInput, number: str = "1") -> None:
        assert source.url is not None
        host = urlsplit(source.url).netloc
        self.socket = connect(f"ws://{host}/socket?page={number}", origin=Origin(f"http://{host}"), compression=None)
        self._seq = 0

    def send(self, **hands: Any) -> None:
        self._seq += 1
        self.socket.send(json.dumps({"seq": self._seq, "hands": hands}))

    def close(self) -> None:
        self.socket.close()

    def ended(self) -> str:
        """Wait until the server closes the connection. Return the code and the reason."""
        with suppress(ConnectionClosed):
            for _ in self.socket:
                pass
        return f"{self.socket.close_code} {self.socket.close_reason}"


def samples(source: WebXrInput, until: Callable[[list[HandSample]], object]) -> list[HandSample]:
    got: list[HandSample] = []

    def look() -> object:
        got.extend(source.poll(0.0))
        return until(got)

    wait_until(look)
    return got


def refused(source: WebXrInput, origin: str | None = None, query: str | None = None) -> bool:
    """Return whether the server refuses the socket."""
    # An SSL connection must not be used by two threads, as the client of the package websockets does. So this function
    # uses http.client.
    assert source.url is not None
    scheme, host, _, token, _ = urlsplit(source.url)
    connection = HTTPConnection(host, timeout=60.0)
    if scheme == "https":
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        connection = HTTPSConnection(host, timeout=60.0, context=context)
    headers = {"Origin": origin or f"{scheme}://{host}", "Upgrade": "websocket", "Connection": "Upgrade"}
    headers |= {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
    with closing(connection):
        connection.request("GET", f"/socket?{token if query is None else query}", headers=headers)
        status = connection.getresponse().status
    assert status in (101, 403)
    return status == 403
