"""A headset's page without a headset: what it sends to a run, and what the run's server answers."""

from __future__ import annotations

import json
import ssl
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.types import HandSample
from tests.support.processes import wait_until

Listen = Callable[..., WebXrInput]
AT_REST = (0.0, 0.0, 0.0, 1.0)


def page_of(
    source: WebXrInput, number: str = "1", origin: str | None = None, query: str | None = None
) -> ClientConnection:
    assert source.url is not None
    scheme, host, _, token, _ = urlsplit(source.url)
    context = None
    if scheme == "https":
        context = ssl.create_default_context()
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    asked = f"{token if query is None else query}&page={number}"
    secure = "s" if context else ""
    url = f"ws{secure}://{host.replace('0.0.0.0', '127.0.0.1')}/socket?{asked}"
    return connect(
        url, origin=Origin(f"{scheme}://{host}" if origin is None else origin), ssl=context, compression=None
    )


def hand(x: float, *buttons: bool, **more: Any) -> dict[str, Any]:
    pressed = [*buttons, False, False, False][:3]
    return {"pose": [x, 0.0, 1.0, *AT_REST], "buttons": pressed, "axes": [0.0] * 4} | more


class Page:
    """A page that numbers its messages."""

    def __init__(self, source: WebXrInput, number: str = "1") -> None:
        self.socket = page_of(source, number)
        self._seq = 0

    def send(self, **hands: Any) -> None:
        self._seq += 1
        self.socket.send(json.dumps({"seq": self._seq, "hands": hands}))

    def close(self) -> None:
        self.socket.close()

    def ended(self) -> str:
        """Why the run has ended it."""
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


def refused(source: WebXrInput, **asked: str) -> bool:
    try:
        page_of(source, **asked).close()
    except InvalidStatus as error:
        return error.response.status_code == 403
    return False
