"""On the page for headsets, keys and a gamepad move a virtual hand.

Its poses pass the same gate, anchor and leash as the poses of a headset.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from playwright.sync_api import Page

from q2r2_control.types import Array
from tests.web.browser import count, pixels, wait_until
from tests.web.conftest import Open, Start
from tests.web.headset_page import Listen
from tests.web.test_headset import ORANGE, RUN, arms, emulated, said, wait_until_said

STICK_FORWARD = """navigator.getGamepads = () => [{
    mapping: "standard", axes: [0, -1, 0, 0], buttons: Array.from({ length: 17 }, () => ({ pressed: false })) }]"""


# JavaScript that presses the key ``window.pressed`` again each time before the page reads its keys. The key therefore
# stays held, however slowly the page draws and sends.
HOLDING = """() => {
    const look = setInterval.bind(window);
    window.setInterval = (then, period) => look(() => {
        if (window.pressed) dispatchEvent(new KeyboardEvent("keydown", { code: window.pressed }));
        then();
    }, period);
}"""


def hold(page: Page, code: str) -> None:
    """Press a key of the keyboard, and hold it until :func:`let_go`."""
    page.evaluate("code => { window.pressed = code; }", code)
    page.keyboard.down(code)


def let_go(page: Page, code: str) -> None:
    page.evaluate("() => { window.pressed = null; }")
    page.keyboard.up(code)


def targets_of_left(page: Page) -> Array:
    """Return the position (3,) of the left arm's target [m]."""
    return np.array(arms(page, "target")[0][:3])


def test_keys_and_a_gamepad_engage_and_move_an_arm_which_stops_when_flying_by_keyboard_ends(
    open_page: Open, start: Start
) -> None:
    run = start(*RUN)
    page = open_page(run.url, emulated())
    wait_until(lambda: said(page) is not None)
    page.evaluate(HOLDING)
    page.click("#fly")
    wait_until(lambda: count(pixels(page), ORANGE) > 5)
    hold(page, "Space")
    wait_until_said(page, lambda: arms(page, "state") == ["engaged", "idle"])
    let_go(page, "Space")
    before = targets_of_left(page)
    hold(page, "KeyW")
    wait_until_said(page, lambda: targets_of_left(page)[0] > before[0] + 0.02)
    let_go(page, "KeyW")
    page.evaluate(STICK_FORWARD)
    stood = targets_of_left(page)[0]
    wait_until_said(page, lambda: targets_of_left(page)[0] > stood + 0.02)
    assert np.allclose(targets_of_left(page)[1:], before[1:], atol=1e-3)
    page.evaluate("document.getElementById('fly').click()")
    wait_until_said(page, lambda: arms(page, "state")[0] == "lost")
    run.interrupt()
    assert run.end()["at_rest"]


# JavaScript that runs the page's class `Flying`, which moves a virtual hand by keyboard. Simulated time advances by
# 20 ms before each call of `read`.
LOOKS = """async ([events, looks, unsent = 0]) => {
    const { Flying } = await import("/fly.js");
    let now = performance.now();
    performance.now = () => now;
    const flying = new Flying();
    const before = flying.poses.left[0];
    for (const [type, init] of events) dispatchEvent(new KeyboardEvent(type, init));
    const held = [];
    for (let look = 0; look < looks; look++) {
        now += 20;
        const { left, right } = flying.read();
        held.push(left.buttons[1] || right.buttons[1]);
        if (look >= unsent) flying.told();
    }
    flying.end();
    delete performance.now;
    return { moved: flying.poses.left[0] - before, held };
}"""


def flown(page: Page, *events: tuple[str, Mapping[str, object]]) -> float:
    """Return how far the left hand moves forwards in the 4 s after these events of the keyboard [m]."""
    return float(page.evaluate(LOOKS, [events, 200])["moved"])


def test_a_key_whose_release_is_never_reported_moves_a_hand_only_for_a_short_time(
    open_page: Open, listen: Listen
) -> None:
    page = open_page(str(listen().url), "")
    forward, ctrl = {"code": "KeyW"}, {"code": "ControlLeft", "key": "Control", "ctrlKey": True}
    down, repeated = ("keydown", forward), ("keydown", forward | {"repeat": True})
    assert 0.05 < flown(page, down) < 0.12
    assert 0.05 < flown(page, down, repeated) < 0.12
    assert flown(page, repeated) == 0.0
    # A browser on a Mac reports no release of W while Cmd is held. Each modifier key therefore ends the motion.
    for modifier in ("ctrlKey", "metaKey", "altKey"):
        assert flown(page, ("keydown", forward | {modifier: True})) == 0.0
    assert flown(page, down, ("keydown", ctrl), repeated) == 0.0
    assert flown(page, down, ("keyup", ctrl | {"ctrlKey": False})) == 0.0


def test_a_held_button_stays_held_while_other_keys_are_pressed_but_only_for_a_limited_time(
    open_page: Open, listen: Listen
) -> None:
    page = open_page(str(listen().url), "")
    space = {"code": "Space"}
    held = page.evaluate(LOOKS, [[("keydown", space), ("keydown", {"code": "KeyW"})], 60])["held"]
    assert held[:30] == [True] * 30
    assert held[-10:] == [False] * 10


def test_a_tap_between_two_messages_is_in_the_next_message_if_that_message_is_sent_soon_for_the_same_hand(
    open_page: Open, listen: Listen
) -> None:
    page = open_page(str(listen().url), "")
    down, up = ("keydown", {"code": "Space"}), ("keyup", {"code": "Space"})

    def held(*events: tuple[str, Mapping[str, object]], unsent: int = 0) -> int:
        """Return how many messages say that the button is down."""
        return sum(page.evaluate(LOOKS, [events, 200, unsent])["held"])

    assert held(down, up) == 1
    assert held(down, up, unsent=3) == 4  # The first three messages are not sent.
    # The button is held for less than 150 ms. After that, the arm stops because messages are missing.
    assert held(down, up, unsent=200) == 6
    assert held(down, up, ("blur", {})) == 0
    assert held(down, up, ("keydown", {"code": "Digit2"})) == 0
    assert held(down, ("keydown", {"code": "Digit2"})) == 0  # The key is still held here.
    assert held(down, up, ("keydown", {"code": "KeyW", "ctrlKey": True})) == 0


# JavaScript that lets the page draw only when the test calls ``draw``, and keeps the messages that the page sends.
STANDING = """(() => {
    const { now } = performance;
    window.later = 0;
    performance.now = () => now.call(performance) + window.later;
    window.requestAnimationFrame = (then) => { window.draw = () => then(performance.now()); return 0; };
    window.hands = [];
    const { send } = WebSocket.prototype;
    WebSocket.prototype.send = function (text) {
        const message = JSON.parse(text);
        if (message.hands.left) window.hands.push(message.hands.left);
        return send.call(this, text);
    };
})()"""


def sent(page: Page) -> int:
    return int(page.evaluate("window.hands.length"))


def falls_silent(page: Page) -> None:
    """Check that the page sends no hand any more."""
    before = sent(page)
    page.wait_for_timeout(500)
    assert sent(page) == before


def test_the_page_sends_hands_while_it_draws_nothing_but_only_for_a_limited_time(
    open_page: Open, listen: Listen
) -> None:
    page = open_page(str(listen().url), STANDING)
    wait_until(lambda: "connected" in page.inner_text("#link"))
    page.click("#fly")
    page.evaluate("draw()")
    before = sent(page)
    wait_until(lambda: sent(page) >= before + 3)  # Meanwhile, the page shows the same picture.
    page.evaluate("window.later = 600")  # The picture is now older than is allowed.
    falls_silent(page)
    wait_until(lambda: page.evaluate("draw() || 1") and sent(page) > before + 10)


def test_hands_are_lost_when_the_page_loses_the_focus_and_come_back_only_when_it_has_the_focus_again(
    open_page: Open, listen: Listen
) -> None:
    page = open_page(str(listen().url), STANDING)
    wait_until(lambda: "connected" in page.inner_text("#link"))
    page.click("#fly")
    page.evaluate("draw()")
    wait_until(lambda: sent(page) > 0)
    page.evaluate("() => { document.hasFocus = () => false; dispatchEvent(new Event('blur')); }")
    wait_until(lambda: page.evaluate("window.hands.at(-1).pose") is None)
    falls_silent(page)
    wait_until(lambda: "click on it" in page.inner_text("#slow"))
    page.evaluate("() => { document.hasFocus = () => true; later = 0; draw(); }")
    wait_until(lambda: page.evaluate("draw() || window.hands.at(-1).pose"))


# JavaScript that stops the clock and counts pictures. It reports each picture as finished when the page asks.
COUNTING = """(() => {
    window.clock = performance.now();
    performance.now = () => window.clock;
    window.requestAnimationFrame = (then) => { window.draw = () => then(performance.now()); return 0; };
    window.pictures = 0;
    window.widths = [];
    const { fenceSync } = WebGL2RenderingContext.prototype;
    WebGL2RenderingContext.prototype.fenceSync = function (...all) {
        window.pictures += 1;
        window.widths.push(this.canvas.width);
        return fenceSync.apply(this, all);
    };
    WebGL2RenderingContext.prototype.getSyncParameter = () => WebGL2RenderingContext.SIGNALED;
})()"""
# JavaScript that draws a picture, which takes ``took`` [ms]. It returns how many pictures are drawn up to each of the
# ``times`` after its start [ms], and the widths of these pictures.
PICTURES = """async ([took, times]) => {
    const later = () => new Promise((then) => setTimeout(then, 1));
    const [begin, first] = [window.clock, window.pictures];
    draw();
    window.clock = begin + took;
    await later();
    const drawn = times.map((time) => { window.clock = begin + time; draw(); return window.pictures - first; });
    await later();
    window.clock += 1000;
    return [drawn, window.widths.slice(first)];
}"""


def test_after_a_slow_picture_the_page_draws_nothing_for_the_same_time_and_then_draws_fewer_pixels(
    open_page: Open, listen: Listen
) -> None:
    page = open_page(str(listen().url), COUNTING)
    wait_until(lambda: "connected" in page.inner_text("#link"))
    page.click("#fly")
    page.evaluate("() => { window.clock += 1000; }")
    drawn, widths = page.evaluate(PICTURES, [3, [4, 7]])
    assert drawn == [1, 2]
    assert widths[0] == widths[1]
    drawn, widths = page.evaluate(PICTURES, [40, [41, 79, 81]])
    assert drawn == [1, 1, 2]
    assert widths[1] < widths[0]
    # The time without drawing is at most 100 ms, so that the operator sees the arms.
    assert page.evaluate(PICTURES, [400, [401, 499, 501]])[0] == [1, 1, 2]


ADVICE = """async ([times, now, silent]) => {
    const { Pace } = await import("/pace.js");
    const pace = new Pace();
    for (const time of times) {
        pace.noteSent(time);
        pace.noteDrawn(time);
    }
    return [pace.keptAdvice(now, 0.15, silent), pace.keptAdvice(now + 5000, 0.15, silent)];
}"""


def test_the_advice_about_a_slow_browser_has_its_rate_and_the_cure(open_page: Open, listen: Listen) -> None:
    page = open_page(str(listen().url), "")
    fast = [20 * tick for tick in range(100)]
    assert page.evaluate(ADVICE, [fast, 2000, False])[0] == ""
    slow = [250 * tick for tick in range(10)]
    words, _ = page.evaluate(ADVICE, [slow, 2350, False])
    assert "no hand for 0.25 s, and arms stop after 0.15 s. It draws 4 pictures a second" in words
    assert "Make this window smaller" in words
    # The advice stays while an arm is lost because no hands came. It does not blame a browser that was fast enough.
    assert "came too late, although this browser" in page.evaluate(ADVICE, [fast, 2000, True])[0]
