from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("viser")
pytest.importorskip("playwright")

from playwright.sync_api import BrowserContext, Page, sync_playwright

from tests.web.browser import ARGUMENTS, CHROMIUM, VIEW, WebRun, leave_a_processor_to_the_loop

HIDDEN = "[class*=mantine-Notification] {display: none !important}"  # a warning of slow drawing, which covers an arm
Open = Callable[[str], Page]
Start = Callable[..., WebRun]


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BrowserContext]:
    """One browser for all tests. Its own requests, to update itself, are off."""
    leave_a_processor_to_the_loop()
    folder = tmp_path_factory.mktemp("profile")
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            str(folder), executable_path=CHROMIUM, headless=True, args=ARGUMENTS, viewport=VIEW
        )
        yield context
        context.close()


@pytest.fixture
def open_page(browser: BrowserContext) -> Iterator[Open]:
    pages: list[Page] = []

    def open_one(url: str) -> Page:
        pages.append(browser.new_page())
        pages[-1].goto(url)
        pages[-1].add_style_tag(content=HIDDEN)
        return pages[-1]

    yield open_one
    for page in pages:
        page.close()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start runs with a page, each of which ends with the test."""
    runs: list[WebRun] = []

    def start_one(*options: str, port: int = 0) -> WebRun:
        runs.append(WebRun(tmp_path, *options, port=port))
        return runs[-1]

    yield start_one
    for run in runs:
        run.interrupt()
