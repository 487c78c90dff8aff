"""The messages of a browser that reach viser: those that this page sends, field by field, and no others.

viser itself sets any attribute of a control that a client names, its callbacks too, and opens a public tunnel for
whoever asks. Therefore each message is read here first, and only what was understood is written anew for viser.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
from websockets.asyncio.server import ServerConnection

from q2r2_control.inputs.listener import RateLimit

LONGEST_MESSAGE = 4096  # the longest of the page, its camera, has 400 [bytes]
MOST_MESSAGES = 1000  # of a browser in a second; one that drags both tools sends 160
_PRESS_PERIOD = 0.1  # between two presses of a button that count [s]
_CHANGES = 10  # of a slider or a checkbox in that time; a browser sends 2
_FLOOD = 1008  # WebSocket's code for a breach of policy

_Three = tuple[float, float, float]
_Four = tuple[float, float, float, float]


class _Sent(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """A message of viser's client; the classes have its names."""


class ViewerCameraMessage(_Sent):
    """The browser looks from elsewhere."""

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
    """A gizmo was dragged."""

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
    """The answer of a page that is asked whether it is alive."""

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
    """Decides which messages of browsers viser gets. Used in the thread of the server's event loop only."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._gui: viser.GuiApi | None = None
        self._actions: dict[str, Callable[[], None]] = {}
        self._limits: dict[str, RateLimit] = {}

    def watch(self, gui: viser.GuiApi) -> None:
        """Let browsers use the widgets of ``gui``; before, they can use none."""
        self._gui = gui

    def take_over(self, button: viser.GuiButtonHandle, action: Callable[[], None]) -> None:
        """Do ``action`` at each press of ``button``, which viser never hears of.

        The press counts in any state of viser's widgets, and however busy the threads are that call their callbacks.
        """
        self._actions[button._impl.uuid] = action

    def admitted(self, content: str | bytes) -> bytes | None:
        """The message for viser, written anew, or None if viser shall not get it."""
        if isinstance(content, str):
            return None
        try:
            message: Any = _DECODER.decode(content)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None
        if isinstance(message, GuiUpdateMessage) and not self._is_allowed(message.uuid, message.updates.value):
            return None
        # The same message anew: of two fields that a browser sends with one name, viser might read the other one.
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
        # Only widgets of the page have a limit, so no browser makes this grow.
        return fits and self._limits.setdefault(uuid, RateLimit(count, _PRESS_PERIOD)).take(self.clock())


class FilteredConnection(ServerConnection):
    """A browser's connection, from which viser gets only what ``messages`` admits. A flood ends it."""

    def __init__(self, *all: Any, messages: BrowserMessages, **settings: Any) -> None:
        super().__init__(*all, **settings)
        self._messages, self._rate = messages, RateLimit(MOST_MESSAGES)

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that is admitted."""
        while True:
            content = await super().recv(decode)
            if not self._rate.take(self._messages.clock()):
                await self.close(_FLOOD, f"more than {MOST_MESSAGES} messages in a second")
            elif (message := self._messages.admitted(content)) is not None:
                return message
