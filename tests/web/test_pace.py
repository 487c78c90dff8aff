"""A browser that sends the positions of a dragged tool too slowly gets advice."""

from __future__ import annotations

import pytest

from q2r2_control.viewer.web.pace import BrowserPace


class Browser:
    """A browser that sends positions, and the measurement of its pace. The test sets the clock."""

    def __init__(self) -> None:
        self.now = 100.0
        self.pace = BrowserPace(0.15, lambda: self.now)

    def send(self, period: float, count: int = 5) -> None:
        for _ in range(count):
            self.now += period
            self.pace.note()


@pytest.fixture
def browser() -> Browser:
    """Return a browser in which a drag has just begun."""
    begun = Browser()
    begun.pace.begin()
    return begun


def test_a_browser_that_sends_in_time_gets_no_advice_even_after_the_drag(browser: Browser) -> None:
    browser.send(0.02)
    assert browser.pace.advice(silent=False) == ""
    browser.pace.end()
    browser.now += 5.0
    assert browser.pace.advice(silent=False) == ""
    assert browser.pace.advice(silent=True).startswith("The positions of the dragged tool came too late. Let go, then")


def test_the_advice_for_a_slow_browser_has_its_rate_the_needed_rate_and_the_cure(browser: Browser) -> None:
    browser.send(0.02)
    browser.send(0.5, 1)
    browser.send(0.02)
    words = browser.pace.advice(silent=False)
    assert "no position for 0.50 s, which is 2.0 positions a second" in words
    assert "at least 7 a second. Let go, then drag again" in words
    assert "smaller" in words
    # The advice ends after some time, unless the arm is still lost.
    browser.send(1.0 / 8.0, 100)
    assert browser.pace.advice(silent=False) == ""
    browser.pace.begin()
    assert browser.pace.advice(silent=False) == ""


def test_before_the_first_drag_there_is_no_advice() -> None:
    browser = Browser()
    browser.now += 60.0
    assert browser.pace.advice(silent=False) == ""


def test_a_browser_that_sends_nothing_after_the_start_of_a_drag_gets_advice(browser: Browser) -> None:
    browser.now += 0.4
    assert "no position for 0.40 s" in browser.pace.advice(silent=False)


def test_the_advice_stays_while_the_arm_is_lost(browser: Browser) -> None:
    browser.send(0.5, 1)
    browser.pace.end()
    browser.now += 60.0
    assert "no position for 0.50 s" in browser.pace.advice(silent=True)
