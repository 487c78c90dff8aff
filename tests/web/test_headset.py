"""The page in an emulated headset drives the arms of the simulated cell."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from q2r2_control.types import Array
from tests.web.browser import count, pixels, wait_until
from tests.web.conftest import Open, Start

EMULATOR = Path(os.environ.get("Q2R2_IWER", ".venv/iwer/package")) / "build" / "iwer.min.js"
RUN = ("tests.web.headset_run", "0.004")
LOWER = {"left": "x-button", "right": "a-button"}
UPPER = {"left": "y-button", "right": "b-button"}
# One browser opens both pages. This script hides the browser's storage from the second page. Otherwise that page would
# count as the driver's own page, loaded again.
ANOTHER_BROWSER = "Storage.prototype.getItem = () => null"
ORANGE = (255.0, 107.0, 13.0)  # Colour of the rings on the drawn arms.


def emulated() -> str:
    """Return the script that emulates a headset and gives the tests functions to control it."""
    assert EMULATOR.exists(), f"{EMULATOR} is missing: make test-web fetches it with npm"
    return f"{EMULATOR.read_text()};{Path(__file__).with_name('emulator.js').read_text()}"


@pytest.fixture
def enter(open_page: Open) -> Any:
    """Return a function that opens a page in an emulated headset, and enters VR or AR."""

    def enter_one(url: str, mode: str = "vr") -> Page:
        page = open_page(url, emulated())
        page.set_viewport_size({"width": 320, "height": 220})
        begin(page, mode)
        return page

    return enter_one


def begin(page: Page, mode: str = "vr") -> None:
    """Enter VR or AR from the page, when the page has a state of the run."""
    wait_until(lambda: said(page) is not None)
    page.click(f"#immersive-{mode}")
    wait_until(lambda: page.evaluate("Boolean(headset.activeSession)"))
    frames(page, 10)


def frames(page: Page, count: int) -> None:
    """Wait until the emulator has drawn ``count`` more frames."""
    drawn = page.evaluate("frames")
    wait_until(lambda: page.evaluate("frames") >= drawn + count)


def said(page: Page) -> dict[str, Any] | None:
    """Return the newest state that the page has got from the run; None if it has none."""
    state: dict[str, Any] | None = page.evaluate("said")
    return state


def arms(page: Page, what: str) -> list[Any]:
    state = said(page)
    assert state is not None
    return [arm[what] for arm in state["arms"].values()]


def wait_for(page: Page, states: str, why: str = "") -> None:
    """Wait until both arms are in the state ``states``, with a reason that contains ``why``."""
    wait_until_said(
        page, lambda: arms(page, "state") == [states] * 2 and all(why in words for words in arms(page, "why"))
    )


def wait_until_said(page: Page, condition: Callable[[], object]) -> None:
    """Wait until ``condition`` is true. If it does not become true, the error contains the page's newest state."""
    try:
        wait_until(condition)
    except AssertionError as error:
        told = said(page) or {}
        raise AssertionError(f"the arms: {told.get('arms')}; the link: {page.inner_text('#link')}") from error


def press(page: Page, *buttons: dict[str, str]) -> None:
    for button in buttons:
        page.evaluate("button => press(button)", button)


def targets(page: Page) -> Array:
    """Return the positions (2, 3) of both targets [m]."""
    return np.array(arms(page, "target"))[:, :3]


def test_hands_engage_the_arms_and_move_them_along_the_axes_of_the_room_and_feel_vibrations(
    enter: Any, start: Start
) -> None:
    run = start(*RUN)
    page = enter(run.url)
    wait_for(page, "idle", "not engaged yet")
    press(page, LOWER)
    wait_for(page, "engaged")
    before = targets(page)
    page.evaluate("carry([-0.05, 0.06, -0.07], 60)")  # The motion is to the left, up and forward.
    wait_until_said(page, lambda: np.allclose(targets(page)[0] - before[0], [0.07, 0.05, 0.06], atol=2e-3))
    assert np.allclose(targets(page)[1] - before[1], 0.5 * np.array([0.07, 0.05, 0.06]), atol=2e-3)
    wait_for(page, "engaged", "follows the hand")
    wait_until(lambda: count(pixels(page), ORANGE) > 5)  # The robot is visible, and not only the board with texts.
    # The alignment chord of the left hand stops both arms. Afterwards a press still pauses them.
    page.evaluate("hold(['x-button', 'y-button'], 'left', 1)")
    wait_for(page, "aligning")
    page.evaluate("hold(['x-button', 'y-button'], 'left', 0)")
    wait_for(page, "engaged")
    press(page, LOWER)
    wait_for(page, "paused", "{lower}")
    felt = page.evaluate("vibrations.filter(one => one.amplitude > 0).map(one => one.hand)")
    assert {"left", "right"} <= set(felt)
    assert page.evaluate("pulses") > 3
    # The emulator covers the button, so the mouse cannot click it.
    page.evaluate("document.getElementById('leave').click()")
    wait_until(lambda: not page.evaluate("Boolean(headset.activeSession)"))
    run.interrupt()
    assert run.end()["at_rest"]


def test_if_the_hands_are_lost_for_any_reason_the_arms_stop_until_a_new_press(enter: Any, start: Start) -> None:
    run = start(*RUN)
    page = enter(run.url)

    def engage() -> None:
        press(page, LOWER)
        wait_for(page, "engaged")

    engage()
    page.evaluate("guessed = true")  # The controllers are out of the headset's sight.
    wait_for(page, "lost", "does not see the hand")
    page.evaluate("guessed = false")
    frames(page, 20)
    wait_for(page, "lost")
    engage()
    # The page is hidden, as if the headset's menu were open or the headset taken off. Meanwhile, the socket accepts no
    # message.
    page.evaluate("full = true, headset.updateVisibilityState('hidden')")
    frames(page, 5)
    page.evaluate("full = false")
    wait_for(page, "lost", "does not see the hand")
    page.evaluate("headset.updateVisibilityState('visible')")
    frames(page, 20)
    wait_for(page, "lost")
    engage()
    page.evaluate("void carry([0.0, 0.3, 0.0], 400)")
    frames(page, 30)
    page.reload()  # The reload comes in the middle of a motion.
    begin(page)
    frames(page, 20)
    wait_for(page, "lost", "connection lost")
    engage()
    page.evaluate("headset.activeSession.end()")
    wait_for(page, "lost", "does not see the hand")
    run.interrupt()
    assert run.end()["at_rest"]


def test_bare_hands_move_no_arm_after_the_operator_has_laid_down_the_controllers(enter: Any, start: Start) -> None:
    run = start(*RUN)
    page = enter(run.url)
    press(page, LOWER)
    wait_for(page, "engaged")
    page.evaluate("headset.primaryInputMode = 'hand'")
    wait_for(page, "lost", "does not see the hand")
    page.evaluate("carry([0.0, 0.05, 0.0], 60)")
    frames(page, 20)
    wait_for(page, "lost")
    # The operator picks up the controllers again, and a press engages the arms.
    page.evaluate("headset.primaryInputMode = 'controller'")
    frames(page, 60)
    wait_for(page, "lost")
    press(page, LOWER)
    wait_for(page, "engaged")
    run.interrupt()
    assert run.end()["at_rest"]


def test_the_first_headset_drives_and_the_page_of_a_second_headset_says_that_another_headset_drives(
    enter: Any, start: Start, open_page: Open
) -> None:
    run = start(*RUN)
    page = enter(run.url, "ar")
    other = open_page(run.url, ANOTHER_BROWSER)
    wait_until(lambda: "drives" in other.inner_text("#link"))
    press(page, LOWER)
    wait_for(page, "engaged")
    run.interrupt()
    assert run.end()["at_rest"]
