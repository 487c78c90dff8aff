"""The server of a headset's page decides which page drives, and makes samples from the messages of that page."""

from __future__ import annotations

import json
import math
from contextlib import ExitStack, closing, suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from q2r2_control.inputs.headset_check import watch_headset
from q2r2_control.inputs.webxr.page_messages import LONGEST
from q2r2_control.inputs.webxr.webxr import WebXrInput
from q2r2_control.teleop.crossed_hands import CrossedHands
from q2r2_control.types import HandFault, HapticFeedback
from tests.support.processes import cell, wait_until
from tests.web.browser import PATIENCE
from tests.web.headset_page import Listen, Page, hand, samples

NOISE = np.random.default_rng(3)


def test_the_pose_and_all_controls_of_a_hand_arrive_as_the_page_sent_them(listen: Listen) -> None:
    source = listen()
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
def test_a_missing_or_guessed_pose_and_a_moved_frame_are_faults_of_the_sample(
    listen: Listen, told: dict[str, Any], fault: HandFault
) -> None:
    source = listen()
    with closing(Page(source)) as page:
        page.send(right=hand(1.0, **told))
        assert samples(source, len)[0].fault is fault


def test_if_several_messages_arrive_at_once_the_newest_pose_counts_and_no_press_is_lost(listen: Listen) -> None:
    source = listen()
    with closing(Page(source)) as page:
        page.send(left=hand(0.0))
        samples(source, len)
        burst = [hand(x, False, x == 4.0) for x in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)]
        # All messages arrive at once, as after an interruption of the Wi-Fi.
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
def test_an_invalid_message_ends_only_the_connection_of_its_own_page(listen: Listen, content: str | bytes) -> None:
    source = listen()
    with closing(Page(source)) as page:
        page.socket.send(content)
        assert page.ended()[:4] in ("4002", "1009")
    with closing(Page(source)) as page:
        page.send(left=hand(5.0))
        assert samples(source, len)[0].position[0] == 5.0


def test_poses_that_are_not_finite_arrive_unchanged_so_that_the_gate_judges_them(
    listen: Listen,
) -> None:
    source = listen()
    with closing(Page(source)) as page:
        page.socket.send('{"seq": 1, "hands": {"left": {"pose": [NaN, Infinity, 0, 0, 0, 0, 1e300]}}}')
        sample = samples(source, len)[0]
    assert math.isnan(sample.position[0])
    assert sample.fault is None


def test_a_flood_of_messages_ends_the_connection_of_its_page(listen: Listen) -> None:
    source = listen()
    with closing(Page(source)) as page:
        try:
            for _ in range(2000):
                page.send()
        except ConnectionClosed:
            pass
        assert "messages in a second" in page.ended()


def test_the_first_page_drives_and_a_reloaded_page_replaces_its_own_old_connection(listen: Listen) -> None:
    source = listen(silence=PATIENCE)
    with closing(Page(source, "1")) as first:
        first.send(left=hand(1.0))
        samples(source, len)
        peer = source.statistics.peer
        with closing(Page(source, "2")) as second:
            # The second text comes if the machine is so busy that the first page has been silent for a while.
            assert second.ended() in (f"4001 {peer} drives", f"4001 {peer} is connected")
        # The first connection falls silent, as if it were lost without a message. The same page tries to connect again.
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


def test_a_page_that_falls_silent_is_dropped(listen: Listen) -> None:
    source = listen()
    with closing(Page(source)) as page:
        page.send()
        wait_until(lambda: source.connected)
        assert page.ended() == "4002 no message for 2 s"
    wait_until(lambda: source.statistics.last_disconnect == "no message for 2 s")


def test_vibrations_reach_the_page_that_drives(listen: Listen) -> None:
    source = listen(silence=PATIENCE)
    with closing(Page(source)) as page:
        page.send()
        wait_until(lambda: source.connected)
        source.send_haptic(HapticFeedback("left", 2.0, 0.4))
        source.send_haptic(HapticFeedback("left", 0.5, math.nan))
        told = json.loads(page.socket.recv(timeout=60.0))
    assert told == {"vibration": {"hand": "left", "frequency": 1.0, "amplitude": 0.4}}


def test_the_newest_picture_reaches_the_page_that_drives(listen: Listen) -> None:
    source = listen(silence=PATIENCE)
    with closing(Page(source)) as page:
        page.send()
        wait_until(lambda: source.connected)
        for jpeg in (b"first", b"newest"):
            wait_until(partial(source.show_picture, jpeg))
        received: list[str | bytes] = []

        def has_the_newest() -> bool:
            page.send(left=hand(1.0))  # The server sends a picture only after a message of the page.
            with suppress(TimeoutError):
                received.append(page.socket.recv(timeout=0.05))
            return received[-1:] == [b"newest"]

        wait_until(has_the_newest)


def test_headset_check_shows_the_address_of_the_page_and_the_messages_that_the_page_sends(listen: Listen) -> None:
    source, config = listen(silence=PATIENCE), WebXrInput.cell(cell())
    alone = watch_headset(source, config, 0.0, lambda check: None, lambda: False, CrossedHands(config.teleop.axes))
    assert f"open {source.url} in the headset's browser" in alone.advice
    assert len(alone.missing) == 4
    with closing(Page(source)) as page:
        page.send(left=hand(0.0), right=hand(0.5))
        page.send(left=hand(0.1), right=hand(0.5))
        wait_until(lambda: len(source.statistics.topics) == 4 and source.statistics.topics["q2r_left_hand_pose"].count)
        check = watch_headset(source, config, 0.0, lambda check: None, lambda: False, CrossedHands(config.teleop.axes))
    assert (check.missing, check.advice) == ((), ())
    assert set(check.directions) == {"left", "right"}
