"""viser gets only messages that this page sends. No message of one browser changes a widget for other browsers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import msgspec
import pytest
import viser
from websockets.exceptions import ConnectionClosed

from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.viewer.web.browser_messages import LONGEST_MESSAGE, MOST_MESSAGES, BrowserMessages
from q2r2_control.viewer.web.door import Door
from q2r2_control.viewer.web.exchange import PageRequest
from q2r2_control.viewer.web.view import PageView
from tests.pipeline.loops import pipeline
from tests.support.page_client import PageClient
from tests.support.processes import wait_until

UPLOAD = {"source_component_uuid": "", "transfer_uuid": "", "filename": "", "mime_type": "", "part_count": 1}
PART = {"source_component_uuid": "", "transfer_uuid": "", "part_index": 0, "content": b"0"}
REFUSED = [
    {"type": "ShareUrlRequest"},
    {"type": "ShareUrlDisconnect"},
    {"type": "FileTransferStartUpload", "size_bytes": 1, **UPLOAD},
    {"type": "FileTransferPart", **PART},
    {"type": "GuiFormDirtyMessage", "uuid": "", "is_dirty": True},
    {"type": "TransformControlsDragStartMessage", "name": "/gizmos/left", "owner": "", "more": 1},
    {"type": "TransformControlsDragStartMessage", "name": ["/gizmos/left"], "owner": ""},
]
# These updates would change viser's own data of a widget, or give the widget a value of another type.
CHANGES: list[dict[str, Any]] = [
    {"removed": True},
    {"update_cb": []},
    {"value": True, "removed": True},
    {"value": "True"},
    {},
]


@pytest.fixture
def gui() -> Iterator[viser.GuiApi]:
    door = Door("127.0.0.1", 0)
    with door.guards("cell"):
        server = viser.ViserServer(host="127.0.0.1", port=door.port, verbose=False)
    yield server.gui
    server.stop()


@pytest.fixture
def asked() -> list[object]:
    """Return a list to which the page appends the requests of its buttons."""
    return []


@pytest.fixture
def page(asked: list[object]) -> Iterator[Callable[[], PageClient]]:
    """Return a function that opens the page of a run."""
    with PageView("127.0.0.1", 0) as view:
        url = view.serve(pipeline(ScriptedInput("circle")), "hostile", on_request=asked.append)
        yield lambda: PageClient(url)


def changed(uuid: str, updates: dict[str, Any]) -> bytes:
    content: bytes = msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": uuid, "updates": updates})
    return content


def uuid_of(handle: Any) -> str:
    return str(handle._impl.uuid)


@pytest.mark.parametrize("message", REFUSED, ids=lambda message: message["type"])
def test_a_message_that_this_page_never_sends_is_refused(message: dict[str, Any], gui: viser.GuiApi) -> None:
    messages = BrowserMessages()
    messages.watch(gui)
    assert messages.admitted(msgspec.msgpack.encode(message)) is None
    known = {name: value for name, value in message.items() if name != "more"} | {"name": "/gizmos/left"}
    if message["type"].startswith("Transform"):
        assert messages.admitted(msgspec.msgpack.encode(known)) is not None


def test_a_field_that_is_sent_twice_cannot_make_viser_read_another_message(gui: viser.GuiApi) -> None:
    """Of two fields with the same name, viser reads the last one."""
    messages = BrowserMessages()
    camera = [("type", "TransformControlsDragEndMessage"), ("name", "/a"), ("owner", ""), ("type", "ShareUrlRequest")]
    content = bytes([0x80 + len(camera)]) + b"".join(msgspec.msgpack.encode(part) for pair in camera for part in pair)
    admitted = messages.admitted(content)
    assert admitted is None or msgspec.msgpack.decode(admitted)["type"] != "ShareUrlRequest"


def test_a_widget_accepts_only_values_of_its_type_and_range(gui: viser.GuiApi) -> None:
    messages = BrowserMessages()
    slider, box = gui.add_slider("share", 0.1, 1.0, 0.1, 0.5), gui.add_checkbox("shadows", False)
    text = gui.add_text("text", "")

    def admits(handle: Any, updates: dict[str, Any]) -> bool:
        return messages.admitted(changed(uuid_of(handle), updates)) is not None

    assert not admits(box, {"value": True}), "before the page is complete"
    messages.watch(gui)
    assert admits(box, {"value": True})
    assert [admits(slider, {"value": value}) for value in (0.1, 1, 0.0, 1.1, float("nan"), True)] == [True] * 2 + [
        False
    ] * 4
    assert not admits(text, {"value": 1.0})
    for handle in (slider, box):
        assert not any(admits(handle, {"value": 1.0, "min": -9.0}) or admits(handle, one) for one in CHANGES)


def test_at_most_ten_presses_of_a_button_count_in_a_second_but_every_press_of_stop_counts(gui: viser.GuiApi) -> None:
    now = 0.0
    messages, stops = BrowserMessages(lambda: now), []
    messages.watch(gui)
    stop, pause, home = (gui.add_button(label) for label in ("stop", "pause", "home"))
    messages.take_over(stop, lambda: stops.append(now))
    counted = 0
    for tick in range(1000):
        now = 1e-3 * tick
        counted += messages.admitted(changed(uuid_of(pause), {"value": True})) is not None
        messages.admitted(changed(uuid_of(stop), {"value": True}))
    assert counted == 10
    assert len(stops) == 1000
    assert messages.admitted(changed(uuid_of(home), {"value": True})) is not None, "a flood of another button"


def test_the_stop_button_works_whatever_another_page_sends(page: Callable[[], PageClient], asked: list[object]) -> None:
    with page() as hostile, page() as honest:
        for label in ("Stop", "Pause"):
            for updates in CHANGES:
                hostile.send("GuiUpdateMessage", uuid=hostile.button(label), updates=updates)
        hostile.send("ShareUrlRequest")
        # When this press has an effect, the server has read all messages before it.
        hostile.press("Bring both arms home")
        wait_until(lambda: asked)
        honest.press("Pause")
        honest.press("Stop")
        wait_until(lambda: len(asked) >= 3)
    assert asked[0] is PageRequest.HOME
    assert set(asked[1:]) == {PageRequest.PAUSE, PageRequest.STOP}


@pytest.mark.parametrize("attack", ["flood", "upload"])
def test_a_flood_of_messages_or_an_upload_ends_only_the_connection_of_its_sender(
    attack: str, page: Callable[[], PageClient], asked: list[object]
) -> None:
    with page() as hostile, page() as honest:
        pause = honest.button("Pause")
        with suppress(ConnectionClosed):
            if attack == "upload":
                hostile.send("FileTransferPart", **PART | {"content": bytes(LONGEST_MESSAGE)})
            for _ in range(2 * MOST_MESSAGES):
                hostile.send("GuiUpdateMessage", uuid=pause, updates={"value": True})
        with pytest.raises(ConnectionClosed, match="1008" if attack == "flood" else "1009"):
            hostile.wait_until(lambda: False)
        honest.press("Stop")
        wait_until(lambda: PageRequest.STOP in asked)
    assert asked.count(PageRequest.PAUSE) < MOST_MESSAGES / 2
