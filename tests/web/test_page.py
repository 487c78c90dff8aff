"""A stranger's look at a run, and its buttons, in a real browser."""

from __future__ import annotations

from urllib.parse import urlsplit

import numpy as np

from tests.web.browser import on_screen, pixels, table, tool, tool_at_home, wait_for, wait_until
from tests.web.conftest import Open, Start

ORANGE = (255.0, 107.0, 13.0)  # of the arms' rings


def test_the_page_shows_both_arms_and_its_buttons_end_the_run_in_rest(open_page: Open, start: Start) -> None:
    run = start("--input", "scripted", "--trajectory", "circle")
    page = open_page(run.url)
    wait_for(page, "certified")
    wait_until(lambda: table(page)["state"] == ["engaged", "engaged"])
    # Rings of both arms, left and right of the middle, which no empty scene has.
    wait_until(lambda: all(half > 20 for half in _orange(pixels(page))))
    page.get_by_text("Pause both arms").click()
    wait_until(lambda: "a program asks for a pause" in table(page)["why"][1])
    page.get_by_text("Bring both arms home").click()
    wait_until(lambda: "at home" in table(page)["why"][0])
    page.get_by_text("Stop: rest, and end the run").click()
    summary = run.end()
    assert summary["at_rest"]
    # The same page shows the next run at this address.
    again = start("--input", "scripted", port=urlsplit(run.url).port or 0)
    wait_until(lambda: table(page).get("why", ["the run ends"])[0] != "the run ends")
    again.interrupt()
    assert again.end()["at_rest"]


def _orange(picture: np.ndarray) -> tuple[int, int]:
    near = np.abs(picture - ORANGE).max(axis=2) < 70.0
    middle = near.shape[1] // 2
    return int(near[:, :middle].sum()), int(near[:, middle:].sum())


def test_a_page_drags_a_tool_as_a_hand_does_and_no_other_page_can_meanwhile(open_page: Open, start: Start) -> None:
    run = start("--input", "web")
    page = open_page(run.url)
    wait_for(page, "certified")
    before = tool(page)
    home = tool_at_home("left")
    handle, end = home.act(np.array([0.0, 0.0, 0.13])), home.act(np.array([0.0, 0.0, 0.07]))
    page.mouse.move(*on_screen(page, handle))
    page.wait_for_timeout(500)
    page.mouse.down()
    page.mouse.move(*on_screen(page, end), steps=6)
    wait_until(lambda: table(page)["state"][0] == "engaged")
    wait_until(lambda: np.linalg.norm(tool(page) - before) > 0.02)
    # Another page cannot take over, and a driver that is gone stops the arm.
    other = open_page(run.url)
    wait_for(other, "drives")
    where = tool(other, 1)
    right = tool_at_home("right")
    other.mouse.move(*on_screen(other, right.act(np.array([0.0, 0.0, 0.13]))))
    other.mouse.down()
    other.mouse.move(*on_screen(other, right.act(np.array([0.0, 0.0, 0.07]))), steps=4)
    other.wait_for_timeout(500)
    other.mouse.up()
    assert table(other)["state"] == ["engaged", "idle"]
    assert np.allclose(tool(other, 1), where)
    page.close()
    wait_until(lambda: table(other)["state"][0] == "lost")
    assert "connection lost" in table(other)["why"][0]
    run.interrupt()
    assert run.end()["at_rest"]
