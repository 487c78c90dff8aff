"""What the page of a run shows in a real browser, and what its buttons do."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from q2r2_control.recording.about import About
from q2r2_control.recording.recorder import Recorder
from tests.pipeline.loops import pipeline
from tests.support.page_client import PageClient
from tests.support.processes import CELL
from tests.web.browser import (
    count,
    drag,
    grab,
    on_arrow,
    pixels,
    table,
    tool,
    wait_for,
    wait_for_row,
    wait_until,
)
from tests.web.conftest import Open, Start

ORANGE = (255.0, 107.0, 13.0)  # Colour of the arms' rings.
SLOW = "tests.web.slow_run"


def test_the_page_shows_both_arms_and_its_buttons_end_the_run_with_the_arms_at_rest(
    open_page: Open, start: Start
) -> None:
    run = start(SLOW, "circle", "0", "0.002")
    page = open_page(run.url)
    wait_for(page, "certified")
    for arm in (0, 1):
        wait_for_row(page, "state", arm, "engaged")
    # The arms have orange rings, left and right of the middle. An empty scene would show no ring.
    wait_until(lambda: all(count(half, ORANGE) > 5 for half in np.array_split(pixels(page), 2, axis=1)))
    page.get_by_text("Pause both arms").click()
    wait_for_row(page, "why", 1, "a program asks for a pause")
    assert table(page)["next"] == ["nothing: a script moves the hands"] * 2
    # Events without a change of state, such as the event of a slider, do not hide the reason.
    page.get_by_text("Settings", exact=True).click()
    page.locator("input:visible").first.fill("50")
    page.locator("input:visible").first.press("Enter")
    page.wait_for_timeout(5e3)
    assert table(page)["why"] == ["a program asks for a pause"] * 2
    page.get_by_text("Bring both arms home").click()
    wait_for_row(page, "why", 0, "at home")
    assert page.title() == "dual_iiwa7"
    page.get_by_text("Stop: rest, and end the run").click()
    summary = run.end()
    assert summary["at_rest"]
    kinds = [event["kind"] for event in summary["events"]]
    assert kinds.index("control_changed") < kinds.index("homing_arrived")
    # The page stays open. It says that the run is over, and hides the buttons that have no effect any more.
    wait_for(page, "The run is over after")
    assert not page.get_by_text("certified").is_visible()
    assert not page.get_by_text("Bring both arms home").is_visible()
    # The same page shows the next run at this address.
    command = ("q2r2_control", "run", CELL, "--plant", "kinematic", "--headless", "--json", "--web", "--web-port")
    again = start(*command, str(urlsplit(run.url).port))
    wait_for(page, "certified")
    again.interrupt()
    assert again.end()["at_rest"]


def test_a_page_drags_a_tool_like_a_hand_and_no_other_page_can_drag_at_the_same_time(
    open_page: Open, start: Start
) -> None:
    run = start(SLOW, "web", "0", "0.01")
    page, other = open_page(run.url), open_page(run.url)
    for one in (page, other):
        wait_for(one, "certified")
    for words in table(page)["next"]:
        assert words.startswith("drag a tool's arrows or rings to engage")
    before = tool(page)
    grab(page, "left")
    wait_for_row(page, "state", 0, "engaged")
    wait_until(lambda: np.linalg.norm(tool(page) - before) > 0.02)
    # Another page cannot take over.
    wait_for(other, "drives")
    right = tool(other, 1)
    other.mouse.move(*on_arrow(other, "right", 0.13))
    other.mouse.down()
    drag(other, "right", 0.02)
    other.mouse.up()
    # Meanwhile, the first page goes on dragging. When it is closed, the arm stops.
    moved = tool(page)
    drag(page, "left", 0.02)
    wait_until(lambda: np.linalg.norm(tool(other) - moved) > 0.02)
    assert table(other)["state"] == ["engaged", "idle"]
    assert np.allclose(tool(other, 1), right)
    page.close()
    wait_for_row(other, "state", 0, "lost")
    assert "connection lost" in table(other)["why"][0]
    run.interrupt()
    assert run.end()["at_rest"]


def test_the_arrows_return_to_the_tool_when_the_drag_can_no_longer_engage_the_arm(
    open_page: Open, start: Start
) -> None:
    run = start(SLOW, "web", "0", "0.01")
    page = open_page(run.url)
    wait_for(page, "certified")
    grab(page, "left")
    wait_for_row(page, "state", 0, "engaged")
    with PageClient(run.url) as other:
        other.press("Pause both arms")
        wait_for_row(page, "why", 0, "a program asks for a pause")
    wait_for_row(page, "next", 0, "let go, then drag again to engage")
    # The mouse button is still down, but the mouse drags no arrow. A press on the arrow at the tool begins a new drag.
    seen = []
    for to in (0.3, 0.45):
        drag(page, "left", to)
        page.wait_for_timeout(2e3)
        seen.append(pixels(page))
    assert np.abs(seen[1] - seen[0]).max() < 30.0
    stood = tool(page)
    page.mouse.up()
    grab(page, "left", stood)
    wait_for_row(page, "state", 0, "engaged")
    wait_until(lambda: np.linalg.norm(tool(page) - stood) > 0.02)
    run.interrupt()
    assert run.end()["at_rest"]


def test_on_a_phone_the_panel_is_below_the_scene(open_page: Open, start: Start) -> None:
    page = open_page(start(SLOW, "web", "0", "0.01").url)
    page.set_viewport_size({"width": 390, "height": 800})
    wait_for(page, "certified")
    scene = page.locator("canvas").first.bounding_box()
    panel = page.locator(".mantine-Paper-root").first.bounding_box()
    assert scene is not None
    assert panel is not None
    assert scene["height"] >= 300.0
    assert scene["y"] + scene["height"] <= panel["y"]
    assert (scene["width"], panel["width"]) == (390.0, 390.0)


def test_the_page_of_a_replay_has_a_time_line_and_can_be_reloaded_with_its_token(
    open_page: Open, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))  # The certificate is made here.
    loop = pipeline()
    with Recorder(tmp_path, "circle", waits=True) as recorder:
        recorder.begin(About.of(loop, False, {}), loop.robot)
        loop.listeners.append(recorder)
        loop.run(3.0, realtime=False)
    assert recorder.file is not None
    address = ("--web-port", "0", "--web-host", "0.0.0.0")
    run = start("q2r2_control", "replay", str(recorder.file), "--json", "--web", *address)
    url = urlsplit(run.url)
    assert url.scheme == "https"
    page = open_page(url._replace(netloc=f"127.0.0.1:{url.port}").geturl())
    wait_for(page, "3.0 s")  # The replay stands still at its end.
    page.reload()
    wait_for(page, "3.0 s")
    number = page.locator("input:visible").first

    def stands_at(seconds: str) -> bool:
        number.fill(seconds)
        number.press("Enter")
        return bool(page.get_by_text(f"{seconds} s").count())

    wait_until(lambda: stands_at("1.5"))
    before = tool(page)
    page.get_by_text("Play, or stand still").click()
    wait_for(page, "3.0 s")
    assert np.linalg.norm(tool(page) - before) > 0.01
    page.get_by_text("End the replay").click()
    assert run.end()["ended_by"] is None
