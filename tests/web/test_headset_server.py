"""The page's server: who is served, who drives, and what of a page's messages becomes samples."""

from __future__ import annotations

import json
import math
import ssl
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
from cryptography.x509 import SubjectAlternativeName, load_pem_x509_certificate
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from q2r2_control.errors import ConfigError, InputError
from q2r2_control.inputs.headset_check import watch_headset
from q2r2_control.inputs.samples import HandsWatch
from q2r2_control.inputs.webxr.certificate import own_certificate
from q2r2_control.inputs.webxr.page_messages import LONGEST
from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.types import HandFault, HandSample, HapticFeedback
from tests.support.processes import cell, wait_until

AT_REST = (0.0, 0.0, 0.0, 1.0)
NOISE = np.random.default_rng(3)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., WebXrInput]]:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with ExitStack() as stack:

        def start_one(**settings: Any) -> WebXrInput:
            made = WebXrInput(port=0, watch=HandsWatch(None, frame=False), **settings)
            stack.callback(made.close)
            made.start()
            return made

        yield start_one


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


def test_a_hand_arrives_as_the_page_sent_it_with_all_its_controls(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source)) as page:
        sent = hand(1.0, True, False, True) | {"axes": [0.1, -0.2, 0.3, 0.4]}
        sent["pose"] = [1.0, 2.0, 3.0, 0.5, 0.5, 0.5, 0.5]
        page.send(left=sent)
        sample = samples(source, lambda got: any(one.inputs.button_upper for one in got))[-1]
        assert source.connected
    assert (sample.hand, sample.fault) == ("left", None)
    assert [*sample.position, *sample.quaternion] == sent["pose"]
    inputs = sample.inputs
    assert (inputs.button_upper, inputs.button_lower, inputs.more) == (True, False, {"pinch": 1.0})
    axes = (inputs.thumb_stick_horizontal, inputs.thumb_stick_vertical, inputs.press_index, inputs.press_middle)
    assert axes == (0.1, -0.2, 0.3, 0.4)
    wait_until(lambda: not source.connected)


@pytest.mark.parametrize(
    ("told", "fault"),
    [
        pytest.param({"pose": None}, HandFault.UNTRACKED, id="no pose"),
        pytest.param({"fault": "hand_untracked"}, HandFault.UNTRACKED, id="a guessed pose"),
        pytest.param({"fault": "hand_frame_moved"}, HandFault.FRAME_MOVED, id="a recentred room"),
    ],
)
def test_a_pose_that_the_headset_does_not_vouch_for_is_a_fault(
    start: Callable[..., WebXrInput], told: dict[str, Any], fault: HandFault
) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.send(right=hand(1.0, **told))
        assert samples(source, len)[0].fault is fault


def test_of_messages_that_come_together_the_newest_counts_and_every_button(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.send(left=hand(0.0))
        samples(source, len)
        burst = [hand(x, False, x == 4.0) for x in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)]
        # All in one piece of the stream, as after a silence of the Wi-Fi.
        frames = []
        with page.socket.protocol_mutex:
            for index, one in enumerate(burst):
                text = json.dumps({"seq": 10 + index, "hands": {"left": one}})
                page.socket.protocol.send_text(text.encode())
                frames += page.socket.protocol.data_to_send()
            page.socket.socket.sendall(b"".join(frames))
        got = samples(source, lambda got: got and got[-1].position[0] == 7.0)
    places = list(dict.fromkeys(sample.position[0] for sample in got))
    assert places == [3.0, 4.0, 7.0]
    assert any(sample.inputs.button_lower for sample in got)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"\x00" * 100, id="bytes"),
        pytest.param("", id="nothing"),
        pytest.param("{}", id="no number"),
        pytest.param('{"seq": 1, "hands": {"middle": {"pose": null}}}', id="a third hand"),
        pytest.param('{"seq": 1, "hands": {"left": {"pose": [1, 2]}}}', id="half a pose"),
        pytest.param('{"seq": 1, "hands": {"left": {"pose": null, "buttons": [1, 0, 0]}}}', id="numbers for buttons"),
        pytest.param("[" * 4000, id="nesting"),
        pytest.param(NOISE.bytes(500).decode("latin-1"), id="noise"),
        pytest.param("x" * (LONGEST + 1), id="too long"),
    ],
)
def test_garbage_ends_its_own_page_only(start: Callable[..., WebXrInput], content: str | bytes) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.socket.send(content)
        assert page.ended()[:4] in ("4002", "1009")
    with closing(Page(source)) as page:
        page.send(left=hand(5.0))
        assert samples(source, len)[0].position[0] == 5.0


def test_numbers_that_are_none_arrive_for_the_gate_to_judge_as_of_every_headset(
    start: Callable[..., WebXrInput],
) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.socket.send('{"seq": 1, "hands": {"left": {"pose": [NaN, Infinity, 0, 0, 0, 0, 1e300]}}}')
        sample = samples(source, len)[0]
    assert math.isnan(sample.position[0])
    assert sample.fault is None


def test_a_flood_ends_its_page(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source)) as page:
        try:
            for _ in range(2000):
                page.send()
        except ConnectionClosed:
            pass
        assert "messages in a second" in page.ended()


def test_the_first_page_drives_and_one_that_comes_back_takes_its_place(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source, "1")) as first:
        first.send(left=hand(1.0))
        samples(source, len)
        peer = source.statistics.peer
        with closing(Page(source, "2")) as second:
            assert second.ended() == f"4001 {peer} drives"
        # Only after a silence of the first connection, which has been lost without a word. The page tries again.
        with ExitStack() as tries:

            def comes_back() -> bool:
                tries.enter_context(closing(again := Page(source, "1")))
                with suppress(ConnectionClosed):
                    again.send(left=hand(3.0))
                    again.send(left=hand(3.1))
                return source.statistics.connections == 2

            wait_until(comes_back)
            assert samples(source, len)[0].position[0] >= 3.0
            assert "it came back" in first.ended()


def test_a_page_that_falls_silent_is_dropped(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.send()
        wait_until(lambda: source.connected)
        assert page.ended() == "4002 no message for 2 s"
    assert source.statistics.last_disconnect == "no message for 2 s"


def test_vibrations_reach_the_page_that_drives(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.send()
        wait_until(lambda: source.connected)
        source.send_haptic(HapticFeedback("left", 2.0, 0.4))
        source.send_haptic(HapticFeedback("left", 0.5, math.nan))
        told = json.loads(page.socket.recv(timeout=60.0))
    assert told == {"vibration": {"hand": "left", "frequency": 1.0, "amplitude": 0.4}}


def test_the_newest_picture_reaches_the_page_that_drives(start: Callable[..., WebXrInput]) -> None:
    source = start()
    with closing(Page(source)) as page:
        page.send()
        wait_until(lambda: source.connected)
        for jpeg in (b"first", b"newest"):
            wait_until(partial(source.show_picture, jpeg))
        received: list[str | bytes] = []

        def has_the_newest() -> bool:
            page.send(left=hand(1.0))  # a page goes on sending; a picture goes out after one of its messages
            with suppress(TimeoutError):
                received.append(page.socket.recv(timeout=0.05))
            return received[-1:] == [b"newest"]

        wait_until(has_the_newest)


def test_headset_check_shows_what_the_page_sends_and_where_to_open_it(start: Callable[..., WebXrInput]) -> None:
    source, config = start(), WebXrInput.cell(cell())
    alone = watch_headset(source, config, 0.0, lambda check: None, lambda: False)
    assert f"open {source.url} in the headset's browser" in alone.advice
    assert len(alone.missing) == 4
    with closing(Page(source)) as page:
        page.send(left=hand(0.0), right=hand(0.5))
        page.send(left=hand(0.1), right=hand(0.5))
        wait_until(lambda: len(source.statistics.topics) == 4 and source.statistics.topics["q2r_left_hand_pose"].count)
        check = watch_headset(source, config, 0.0, lambda check: None, lambda: False)
    assert (check.missing, check.advice) == ((), ())
    assert set(check.directions) == {"left", "right"}


def refused(source: WebXrInput, **asked: str) -> bool:
    try:
        page_of(source, **asked).close()
    except InvalidStatus as error:
        return error.response.status_code == 403
    return False


def test_only_the_own_page_connects_and_beyond_this_machine_only_with_the_token(
    start: Callable[..., WebXrInput],
) -> None:
    lines: list[str] = []
    near = start()
    far = start(host="0.0.0.0", say=lines.append)
    for source in (near, far):
        assert refused(source, origin="http://example.org")
        assert refused(source, origin="null")
        assert not refused(source)
    assert refused(far, query="")
    assert refused(far, query="token=guess")
    assert far.url is not None
    assert far.url.startswith("https://")
    assert any("new certificate, first use" in line for line in lines)
    assert any("▀" in line or "█" in line for line in lines), "a code for a camera"
    # The same URL in the next run, without a new certificate.
    lines.clear()
    token = urlsplit(far.url).query
    again = start(host="0.0.0.0", say=lines.append)
    assert again.url is not None
    assert urlsplit(again.url).query == token
    assert not any("certificate" in line for line in lines)


def test_a_certificate_is_renewed_before_it_expires_and_for_another_address(tmp_path: Path) -> None:
    now = datetime(2026, 1, 1, tzinfo=UTC)

    def made(address: str, later: int = 0) -> tuple[bytes, str | None]:
        file, line = own_certificate(tmp_path, address, now + timedelta(days=later))
        assert file.stat().st_mode & 0o077 == 0, "the key is this user's only"
        return file.read_bytes(), line

    first, line = made("192.168.1.5")
    assert "first use" in str(line)
    assert made("192.168.1.5", 300) == (first, None)
    second, line = made("192.168.1.5", 360)
    assert second != first
    assert "expires on 2027-01-01" in str(line)
    third, line = made("10.0.0.7", 360)
    assert "not for 10.0.0.7" in str(line)
    names = load_pem_x509_certificate(third).extensions.get_extension_for_class(SubjectAlternativeName).value
    assert {"10.0.0.7", "127.0.0.1", "localhost"} <= {str(name.value) for name in names}
    (tmp_path / "certificate.pem").write_text("nothing")
    assert "cannot be read" in str(made("10.0.0.7")[1])


def test_a_cable_needs_adb_which_says_what_is_missing(
    start: Callable[..., WebXrInput], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="adb, which is not installed: apt install adb"):
        start(by_usb=True)
    adb = tmp_path / "adb"
    adb.write_text("#!/bin/sh\necho 'error: no devices/emulators found' >&2; exit 1\n")
    adb.chmod(0o700)
    with pytest.raises(InputError, match="no devices/emulators found; allowed: one headset in developer mode"):
        start(by_usb=True)
    asked = tmp_path / "asked"
    adb.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    source = start(by_usb=True)
    port = source.address[1]
    source.close()
    assert asked.read_text().splitlines() == [f"reverse tcp:{port} tcp:{port}", f"reverse --remove tcp:{port}"]


def status(url: str) -> int:
    try:
        with urlopen(url, timeout=60.0) as response:
            return int(response.status)
    except HTTPError as error:
        return error.code


def test_only_files_of_the_page_are_served(start: Callable[..., WebXrInput]) -> None:
    url = start().url
    names = ("", "/main.js", "/draw.js", "/style.css")
    assert [status(f"{url}{name}") for name in names] == [200] * 4
    assert status(f"{url}/../server.py") == status(f"{url}/%2e%2e/server.py") == status(f"{url}/__init__.py") == 404


def test_hosts_outside_the_allowed_networks_get_nothing(start: Callable[..., WebXrInput]) -> None:
    allow = cell().headset.model_validate({"allow": ["10.0.0.0/8"]}).networks
    source = start(allow=allow)
    assert status(str(source.url)) == 403
    assert refused(source)


def test_a_port_that_is_taken_and_a_cable_to_another_address_are_one_clear_line(
    start: Callable[..., WebXrInput],
) -> None:
    source = start()
    with pytest.raises(InputError, match=r"cannot listen on 127.0.0.1 port .*allowed: a free port"):
        WebXrInput(port=source.address[1]).start()
    with pytest.raises(ConfigError, match=r"--usb with --host 0\.0\.0\.0"):
        WebXrInput.from_config(cell(), host="0.0.0.0", usb=True)
    with pytest.raises(InputError, match=r"--certificate .*allowed: a PEM file"):
        start(host="0.0.0.0", certificate=Path(__file__))
