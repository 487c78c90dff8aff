"""The texts and buttons of the headset's page on a screen, and the board that shows the texts in VR."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import combinations
from pathlib import Path

import pytest
from playwright.sync_api import Page

from q2r2_control.inputs.samples import HandsWatch
from q2r2_control.inputs.webxr.webxr import WebXrInput
from tests.web.browser import PATIENCE, count, pixels, wait_until
from tests.web.conftest import Open
from tests.web.shown_run import RED, STATE, ShownRun, arm
from tests.web.test_headset import ANOTHER_BROWSER


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ShownRun]:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    source = WebXrInput(port=0, watch=HandsWatch(None, frame=False), silence=PATIENCE)
    made = ShownRun(source)
    source.start()
    with closing(source):
        yield made


def shows(run: ShownRun, page: Page, condition: Callable[[], object]) -> None:
    """Let the run send its state again and again until ``condition`` is true."""

    def look() -> object:
        run.show()
        page.wait_for_timeout(100)
        return condition()

    wait_until(look)


def opened(run: ShownRun, open_page: Open, script: str = "") -> Page:
    page = open_page(str(run.source.url), script)
    shows(run, page, lambda: "no pose" in page.inner_text("#arms"))
    return page


def test_each_press_of_the_buttons_home_pause_and_stop_reaches_the_run_once(run: ShownRun, open_page: Open) -> None:
    page = opened(run, open_page)
    page.click("#home")
    wait_until(lambda: run.asked == ["home"])
    page.click("#pause")
    wait_until(lambda: run.asked == ["home", "pause"])
    page.click("#stop")
    wait_until(lambda: run.asked == ["home", "pause", "stop"])
    # From now on, the space key engages an arm. A browser would also press the last clicked button again at this key.
    # The page has to prevent this.
    page.click("#fly")
    page.keyboard.press("Space")
    page.wait_for_timeout(500)
    assert run.asked == ["home", "pause", "stop"]


def test_the_page_shows_a_state_in_its_colour_and_the_tab_shows_the_name_of_the_cell(
    run: ShownRun, open_page: Open
) -> None:
    page = opened(run, open_page)
    colour = page.evaluate("getComputedStyle(document.querySelector('.state')).backgroundColor")
    assert colour == f"rgb{RED}"
    assert page.title() == "two_arms: drive the arms"
    assert page.inner_text("#arms").count("lost") == 2  # Each arm's state is shown once.


def test_texts_name_the_controls_of_the_device_that_is_used(run: ShownRun, open_page: Open) -> None:
    page = opened(run, open_page)

    def next_of(row: int) -> str:
        return page.locator(".next").nth(row).inner_text()

    assert next_of(0) == "enter VR, or fly by keyboard, to move it"
    page.click("#fly")
    shows(run, page, lambda: next_of(0) == "press Space to engage, press G to close the gripper")
    assert next_of(1) == "press 2 to move this one"
    said = """async ([text, device]) => (await import("/words.js")).worded(text, device)"""
    assert page.evaluate(said, ["{lower} and {upper}", "right"]) == "A and B"
    assert page.evaluate(said, ["{lower}", "left"]) == "X"
    assert page.evaluate(said, ["hold {pinch} to engage", "fingers"]) == "hold the pinch to engage"


@pytest.mark.parametrize("flies", [False, True], ids=["looking on", "flying"])
def test_on_a_phone_no_element_of_the_page_covers_another_element(run: ShownRun, open_page: Open, flies: bool) -> None:
    page = opened(run, open_page)
    page.set_viewport_size({"width": 390, "height": 800})
    if flies:
        page.click("#fly")
    # Without a GPU, a picture has fewer pixels than the view. Both have the same ratio of width to height.
    stretched = "({clientWidth, clientHeight, width, height}) => (width * clientHeight) / (height * clientWidth)"
    scene = page.locator("#scene")
    shows(run, page, lambda: scene.evaluate("scene => scene.clientWidth") == 390)
    shows(run, page, lambda: abs(scene.evaluate(stretched) - 1.0) < 0.05)
    names = [
        "#view",
        "#name",
        "#link",
        "#stop",
        "#pause",
        "#home",
        "#arms",
        "#fly",
        *(["#keys"] if flies else ["#stand"]),
    ]
    boxes = {name: page.locator(name).bounding_box() for name in names}
    for (one, first), (other, second) in combinations(boxes.items(), 2):
        assert first is not None
        assert second is not None
        apart = (
            first["x"] + first["width"] <= second["x"]
            or second["x"] + second["width"] <= first["x"]
            or first["y"] + first["height"] <= second["y"]
            or second["y"] + second["height"] <= first["y"]
        )
        assert apart, f"{one} lies over {other}"
    for name, box in boxes.items():
        assert box is not None
        assert 0.0 <= box["x"] <= box["x"] + box["width"] <= 390.0, name
    view = boxes["#view"]
    assert view is not None
    assert view["height"] > 250.0
    assert count(pixels(page), (230.0, 40.0, 40.0)) > 20  # The block is visible beside the words.


def test_a_page_that_does_not_drive_shows_the_driver_and_the_state_and_can_only_stop_the_run(
    run: ShownRun, open_page: Open
) -> None:
    driver = opened(run, open_page)
    other = opened(run, open_page, ANOTHER_BROWSER)
    assert f"{run.source.statistics.peer} drives" in other.inner_text("#link")
    assert "can only stop the run" in other.inner_text("#link")
    assert other.locator("#home").is_hidden()
    assert other.locator("#pause").is_hidden()
    other.evaluate("""() => {
        for (const name of ["home", "pause"]) {
            document.getElementById(name).disabled = false;
            document.getElementById(name).click();
        }
        document.getElementById("stop").click();
    }""")
    wait_until(lambda: run.asked == ["stop"])
    driver.close()
    wait_until(lambda: "connected" in other.inner_text("#link"))  # Now the other page is allowed to drive.


def test_the_page_says_that_the_run_is_over_and_tries_to_connect_again(run: ShownRun, open_page: Open) -> None:
    page = opened(run, open_page)
    page.click("#fly")
    assert page.locator("#keys").is_visible()
    assert page.inner_text("#flown") == "The left hand moves."
    run.source.close()
    wait_until(lambda: "The run is over" in page.inner_text("#link"))
    page.wait_for_timeout(2500)  # In this time, the page tries to connect again.
    assert "The run is over" in page.inner_text("#link")
    assert page.locator("#stop").is_disabled()
    assert page.inner_text("#arms") == ""
    assert count(pixels(page), (230.0, 40.0, 40.0)) > 20  # The last picture stays.
    assert page.locator("#fly").is_disabled()
    assert page.locator("#keys").is_hidden()
    # When the page gets the focus again, it tries to connect at once.
    page.evaluate("""() => {
        window.tries = 0;
        const Socket = WebSocket;
        window.WebSocket = class extends Socket { constructor(url) { super(url); window.tries += 1; } };
    }""")
    page.evaluate("dispatchEvent(new Event('focus'))")
    assert page.evaluate("window.tries") == 1


BOARD = """async (state) => {
    const { BOARD_DISTANCE, BOARD_WIDTH, Board } = await import("/board.js");
    const { CAPITAL, Panel, SMALLEST, WIDTH } = await import("/panel.js");
    const panel = new Panel();
    panel.draw(state, { open: true, text: "" }, false);
    const aspect = panel.canvas.height / panel.canvas.width;
    const [half, high] = [BOARD_WIDTH / 2, (BOARD_WIDTH * aspect) / 2];
    const letter = (CAPITAL * SMALLEST * BOARD_WIDTH) / WIDTH;
    const nearest = Math.atan(letter / BOARD_DISTANCE);
    const farthest = Math.atan(letter / Math.hypot(BOARD_DISTANCE, half, high));
    const turned = (yaw) => {
        const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
        return [cos, 0, sin, 0, 0, 1, 0, 0, -sin, 0, cos, 0, 0, 1.6, 0, 1];
    };
    const board = new Board();
    board.lookFrom(turned(0));
    const [ahead] = [board.place(aspect)];
    board.lookFrom(turned(0.1));
    const still = board.yaw === 0;
    for (let frame = 0; frame < 90; frame++) board.lookFrom(turned(0.9));
    return { degrees: [nearest, farthest].map((angle) => (angle * 180) / Math.PI), still, yaw: board.yaw,
             centre: [...ahead.slice(12, 15)], up: ahead[5] > 0, rows: panel.rows(state, { open: true }, false) };
}"""


def test_the_board_has_readable_letters_and_follows_the_direction_in_which_the_operator_looks(
    run: ShownRun, open_page: Open
) -> None:
    state = STATE | {"arms": {"left": arm("left", why="paused by {lower}")}}
    board = opened(run, open_page).evaluate(BOARD, state)
    assert min(board["degrees"]) >= 1.5
    assert board["still"]  # The board does not move when the head moves a little.
    assert board["yaw"] == pytest.approx(0.9, abs=0.05)
    x, y, z = board["centre"]
    assert (x, board["up"]) == (0.0, True)
    assert 1.6 < y < 2.4
    assert z < -1.2
    assert [row[0] for row in board["rows"]][:3] == [
        "left: lost",
        "paused by X",
        "press X to engage, press Y to close the gripper",
    ]
