"""Keys and a gamepad fly a hand on the page that headsets open, through the same gate, anchor and leash."""

from __future__ import annotations

import numpy as np
from playwright.sync_api import Page

from q2r2_control.types import Array
from tests.web.browser import count, pixels, wait_until
from tests.web.conftest import Open, Start
from tests.web.test_headset import ORANGE, RUN, arms, emulated, said, wait_until_said

STICK_FORWARD = """navigator.getGamepads = () => [{
    mapping: "standard", axes: [0, -1, 0, 0], buttons: Array.from({ length: 17 }, () => ({ pressed: false })) }]"""


def targets_of_left(page: Page) -> Array:
    """(3,) of the target's position [m]."""
    return np.array(arms(page, "target")[0][:3])


def test_keys_and_a_gamepad_engage_an_arm_move_it_and_leave_it_when_the_page_is_left(
    open_page: Open, start: Start
) -> None:
    run = start(*RUN)
    page = open_page(run.url, emulated())
    wait_until(lambda: said(page) is not None)
    page.click("#fly")
    wait_until(lambda: count(pixels(page), ORANGE) > 5)
    page.keyboard.down("Space")
    wait_until_said(page, lambda: arms(page, "state") == ["engaged", "idle"])
    page.keyboard.up("Space")
    before = targets_of_left(page)
    page.keyboard.down("KeyW")
    wait_until_said(page, lambda: targets_of_left(page)[0] > before[0] + 0.02)
    page.keyboard.up("KeyW")
    page.evaluate(STICK_FORWARD)
    stood = targets_of_left(page)[0]
    wait_until_said(page, lambda: targets_of_left(page)[0] > stood + 0.02)
    assert np.allclose(targets_of_left(page)[1:], before[1:], atol=1e-3)
    page.evaluate("document.getElementById('fly').click()")
    wait_until_said(page, lambda: arms(page, "state")[0] == "lost")
    run.interrupt()
    assert run.end()["at_rest"]
