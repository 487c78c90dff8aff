from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser")
pytest.importorskip("playwright")

from playwright.sync_api import BrowserContext, Page, sync_playwright

from q2r2_control.inputs.samples import HandsWatch
from q2r2_control.inputs.webxr.webxr import WebXrInput
from tests.web.browser import ARGUMENTS, CHROMIUM, HIDDEN, PATIENCE, VIEW, WebRun, one_processor
from tests.web.headset_page import Listen

_COARSE = 0.5  # Pixels of a picture per pixel of the page. They are few because no graphics card draws them.
Open = Callable[..., Page]
Start = Callable[..., WebRun]


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserContext]:
    """Start one browser for all tests. The browser does not look for updates of itself."""
    folder = tmp_path_factory.mktemp("profile")
    with ExitStack() as stack:
        with one_processor():
            playwright = stack.enter_context(sync_playwright())
        context = playwright.chromium.launch_persistent_context(
            str(folder),
            executable_path=CHROMIUM,
            headless=True,
            args=ARGUMENTS,
            viewport=VIEW,
            ignore_https_errors=True,
        )
        yield context
        context.close()


@pytest.fixture
def open_page(browser: BrowserContext) -> Iterator[Open]:
    pages: list[Page] = []

    def open_one(url: str, script: str | None = None) -> Page:
        """Open a page. A ``script`` is given for the headset's page, and runs before the page's own scripts."""
        pages.append(browser.new_page())
        if script is not None:
            pages[-1].add_init_script(script)
        pages[-1].set_default_timeout(1e3 * PATIENCE)
        pages[-1].goto(f"{url}{'&' if '?' in url else '?'}fixedDpr={_COARSE}")
        if script is None:
            pages[-1].add_style_tag(content=HIDDEN)
        return pages[-1]

    yield open_one
    for page in pages:
        page.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Return a function that starts a run with a page. The runs end with the test."""
    runs: list[WebRun] = []

    def start_one(*command: str) -> WebRun:
        runs.append(WebRun(tmp_path / f"errors_{len(runs)}", *command))
        return runs[-1]

    yield start_one
    for run in runs:
        run.kill()


@pytest.fixture
def listen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Listen]:
    """Return a function that starts a server of a headset's page. The servers end with the test."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with ExitStack() as stack:

        def start_one(**settings: Any) -> WebXrInput:
            made = WebXrInput(port=0, watch=HandsWatch(None, frame=False), **settings)
            stack.callback(made.close)
            made.start()
            return made

        yield start_one
