from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("viser")
pytest.importorskip("playwright")

from playwright.sync_api import BrowserContext, Page, sync_playwright

from tests.web.browser import ARGUMENTS, CHROMIUM, HIDDEN, PATIENCE, VIEW, WebRun, one_processor

_COARSE = 0.5  # of a pixel's width, since a processor draws them
Open = Callable[..., Page]
Start = Callable[..., WebRun]


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserContext]:
    """One browser for all tests. Its own requests, to update itself, are off."""
    folder = tmp_path_factory.mktemp("profile")
    with ExitStack() as stack:
        with one_processor():
            playwright = stack.enter_context(sync_playwright())
        context = playwright.chromium.launch_persistent_context(
            str(folder), executable_path=CHROMIUM, headless=True, args=ARGUMENTS, viewport=VIEW
        )
        yield context
        context.close()


@pytest.fixture
def open_page(browser: BrowserContext) -> Iterator[Open]:
    pages: list[Page] = []

    def open_one(url: str, script: str | None = None) -> Page:
        """``script`` runs before those of a page that is not viser's."""
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
    """Start runs with a page, each of which ends with the test."""
    runs: list[WebRun] = []

    def start_one(*command: str) -> WebRun:
        runs.append(WebRun(tmp_path / f"errors_{len(runs)}", *command))
        return runs[-1]

    yield start_one
    for run in runs:
        run.interrupt()
