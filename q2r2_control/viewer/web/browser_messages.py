"""Filter the messages of browsers. viser gets only the kinds of messages that this page sends, with known fields.

A client can make viser set any attribute of a widget, even the widget's callbacks, and can make viser open a public
tunnel. Therefore each message is decoded here first, and only its known fields are encoded again for viser.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
from websockets.asyncio.server import ServerConnection

from q2r2_control.inputs.listener import RateLimit

LONGEST_MESSAGE = 4096  # Allowed length [bytes]. The page's longest message, about its camera, has 400 bytes.
MOST_MESSAGES = 1000  # Allowed messages of a browser per second. A browser that drags both tools sends 160 per second.
_PRESS_PERIOD = 0.1  # A second press of a button within this time is ignored [s].
_CHANGES = 10  # Allowed changes of a slider or a checkbox within ``_PRESS_PERIOD``. A browser sends 2 changes.
_FLOOD = 1008  # Code of WebSocket for a connection that is closed because a client broke a rule.

_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]


class _Sent(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """A message of viser's client. The subclasses have the names that viser gives to its messages."""


class ViewerCameraMessage(_Sent):
    """The camera of the browser was moved."""

    wxyz: _Four
    position: _Three
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: _Three
    up_direction: _Three


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    value: bool | float


class GuiUpdateMessage(_Sent):
    """A button was pressed, or a slider or a checkbox was moved."""

    uuid: str
    updates: _Value


class TransformControlsUpdateMessage(_Sent):
    """A gizmo (arrows and rings at a tool) was dragged."""

    name: str
    wxyz: _Four
    position: _Three
    owner: str


class TransformControlsDragStartMessage(_Sent):
    name: str
    owner: str


class TransformControlsDragEndMessage(_Sent):
    name: str
    owner: str


class LocalStorageGetItemResponseMessage(_Sent):
    """The answer of a page to the question whether its script still runs."""

    value: str | None
    error: str | None
    request_uuid: str


_DECODER = msgspec.msgpack.Decoder(
    ViewerCameraMessage
    | GuiUpdateMessage
    | TransformControlsUpdateMessage
    | TransformControlsDragStartMessage
    | TransformControlsDragEndMessage
    | LocalStorageGetItemResponseMessage
)


class BrowserMessages:
    """Decides which messages of browsers viser gets. Only the thread of the server's event loop may call this class."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._gui: viser.GuiApi | None = None
        self._actions: dict[str, Callable[[], None]] = {}
        self._limits: dict[str, RateLimit] = {}

    def watch(self, gui: viser.GuiApi) -> None:
        """Let browsers use the widgets of ``gui``. Before this call they can use none."""
        self._gui = gui

    def take_over(self, button: viser.GuiButtonHandle, action: Callable[[], None]) -> None:
        """Call ``action`` at each press of ``button``. These presses are not passed on to viser.

        A press therefore counts in any state of viser's widgets, even if the threads for their callbacks are busy.
        """
        self._actions[button._impl.uuid] = action

    def admitted(self, content: str | bytes) -> bytes | None:
        """Return the message for viser, encoded again, or None if viser must not get it."""
        if isinstance(content, str):
            return None
        try:
            message: Any = _DECODER.decode(content)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None
        if isinstance(message, GuiUpdateMessage) and not self._is_allowed(message.uuid, message.updates.value):
            return None
        # The message is encoded again. Otherwise, if a browser sent two fields with one name, viser could read the
        # field that was not checked.
        encoded: bytes = msgspec.msgpack.encode(message)
        return encoded

    def _is_allowed(self, uuid: str, value: bool | float) -> bool:
        if (action := self._actions.get(uuid)) is not None:
            if value is True:
                action()
            return False
        handle = None if self._gui is None else self._gui._gui_input_handle_from_uuid.get(uuid)
        match handle:
            case viser.GuiButtonHandle():
                fits, count = value is True, 1
            case viser.GuiCheckboxHandle():
                fits, count = isinstance(value, bool), _CHANGES
            case viser.GuiSliderHandle():
                fits, count = not isinstance(value, bool) and handle.min <= value <= handle.max, _CHANGES
            case _:
                return False
        # Only widgets of the page have a limit, so no browser can make this dictionary grow.
        return fits and self._limits.setdefault(uuid, RateLimit(count, _PRESS_PERIOD)).take(self.clock())


class FilteredConnection(ServerConnection):
    """A browser's connection. viser gets only the messages that ``messages`` admits.

    If a browser sends too many messages, the connection is closed.
    """

    def __init__(self, *all: Any, messages: BrowserMessages, **settings: Any) -> None:
        super().__init__(*all, **settings)
        self._messages, self._rate = messages, RateLimit(MOST_MESSAGES)

    async def recv(self, decode: bool | None = None) -> Any:
        """Wait for the next message that is admitted, and return it."""
        while True:
            content = await super().recv(decode)
            if not self._rate.take(self._messages.clock()):
                await self.close(_FLOOD, f"more than {MOST_MESSAGES} messages in a second")
            elif (message := self._messages.admitted(content)) is not None:
                return message
