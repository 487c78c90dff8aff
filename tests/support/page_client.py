"""A client of the page's server without a browser. It receives what the server draws, and presses buttons."""

from __future__ import annotations

import re
import time
from base64 import b64decode
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import msgspec
import viser
import zstandard
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

_CAMERA = {
    **{"position": (0.0, 0.0, 0.0), "look_at": (1.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)},
    **{"wxyz": (1.0, 0.0, 0.0, 0.0), "fov": 1.0, "near": 0.1, "far": 9.0, "image_height": 100, "image_width": 100},
}
_PATIENCE = 120.0  # Timeout far above any usual duration [s].


class PageClient:
    """A client of viser's protocol, as a context manager. It reads packed messages, and ignores arrays."""

    def __init__(self, url: str) -> None:
        host = urlsplit(url).netloc
        protocol = [Subprotocol(f"viser-v{viser.__version__}")]
        self._socket = connect(f"ws://{host}", origin=Origin(f"http://{host}"), subprotocols=protocol, max_size=None)
        self._contents: dict[str, str] = {}  # The HTML elements of the panel, by identifier.
        self._folders: dict[str, str] = {}  # Identifiers of folders by label.
        self._orders: dict[str, float] = {}  # Positions of the panel's elements from its top, by identifier.
        self.buttons: dict[str, str] = {}  # Identifiers of buttons by label.
        self.drawn: set[str] = set()  # Names of drawn meshes.
        self.pictures: list[bytes] = []  # Pictures of cameras, in the order of their arrival.
        # The page ignores presses of a browser that has not sent its camera, so this client sends a camera.
        self.send("ViewerCameraMessage", **_CAMERA)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    @property
    def html(self) -> str:
        return "\n".join(self._contents.values())

    @property
    def words(self) -> str:
        """The text of the panel without markup. Cells of a table are separated by |."""
        return re.sub(r"<[^>]*>", "", self.html.replace("</td>", "|"))

    def says(self, text: str) -> bool:
        return text in self.words

    def row(self, name: str) -> list[str]:
        """Return the cells of a row of the panel's table, one for each arm."""
        found = re.search(rf">{re.escape(name)}</td>(.*?)</tr>", self.html)
        return [] if found is None else re.sub(r"<[^>]*>", "", found[1].replace("</td>", "|")).split("|")[:-1]

    def wait_until(self, condition: Callable[[], object]) -> None:
        """Receive until ``condition`` holds. Otherwise, the failure says what the page shows."""
        deadline = time.monotonic() + _PATIENCE
        while not condition():
            assert time.monotonic() < deadline, f"the page says: {self.words}"
            with suppress(TimeoutError):
                self._hear(self._socket.recv(timeout=1.0))

    def press(self, label: str) -> None:
        """Click the button whose label begins with this text."""
        self.send("GuiUpdateMessage", uuid=self.button(label), updates={"value": True})

    def button(self, label: str) -> str:
        """Return the identifier of the button whose label begins with this text."""
        self.wait_until(lambda: any(one.startswith(label) for one in self.buttons))
        (uuid,) = (uuid for one, uuid in self.buttons.items() if one.startswith(label))
        return uuid

    def order_of(self, what: str) -> float:
        """Return the position, from the top of the panel, of the folder ``what`` or of the HTML with this text."""
        named = [uuid for label, uuid in self._folders.items() if label == what]
        (uuid,) = named or [uuid for uuid, text in self._contents.items() if what in text]
        return self._orders[uuid]

    def send(self, kind: str, **fields: Any) -> None:
        """Send a message of viser's protocol, even one that no browser sends."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def _hear(self, data: bytes | str) -> None:
        assert isinstance(data, bytes)
        length = int.from_bytes(data[8:16], "little")
        told: dict[str, Any] = msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + length]))
        for one in told["messages"]:
            if one["type"] == "GuiButtonMessage":
                self.buttons[one["props"]["label"]] = one["uuid"]
            if one["type"] == "GuiFolderMessage":
                self._folders[one["props"]["label"]] = one["uuid"]
            if "order" in one.get("props", {}):
                self._orders[one["uuid"]] = one["props"]["order"]
            if one["type"] == "MeshMessage":
                self.drawn.add(one["name"])
            content = (one.get("props") or one.get("updates") or {}).get("content")
            if isinstance(content, str):
                self._contents[one["uuid"]] = content
                self.pictures += map(b64decode, re.findall(r"base64,([^']*)", content))
