"""Buttons: presses, each once, told from the alignment chord."""

from __future__ import annotations

import math

import pytest

from q2r2_control.teleop.buttons import ButtonArbiter, Press
from q2r2_control.types import HandInputs

WINDOW = 0.075  # between two readings, so that rounding does not matter


def play(script: str, period: float = 0.01, start_released: bool = True) -> list[tuple[Press, float]]:
    """Presses and when they were reported; ``script`` has one letter a reading: . none, u upper, l lower, b both."""
    arbiter = ButtonArbiter(WINDOW)
    found, t = [], 0.0
    for letter in ("." if start_released else "") + script:
        inputs = HandInputs(button_upper=letter in "ub", button_lower=letter in "lb")
        reported = arbiter.receive(inputs, t, t) + arbiter.due(t)
        found += [(press, round(t - period * start_released, 6)) for press in reported]
        t += period
    return found


@pytest.mark.parametrize(
    ("script", "expected"),
    [
        ("....", []),
        ("l" * 12, [(Press.LOWER_DOWN, 0.0), (Press.LOWER, 0.08)]),
        ("lll.....", [(Press.LOWER_DOWN, 0.0), (Press.LOWER, 0.03)]),
        ("u" * 30, [(Press.UPPER_DOWN, 0.0), (Press.UPPER, 0.08)]),
        (
            "uu.uu.",
            [(Press.UPPER_DOWN, 0.0), (Press.UPPER, 0.02), (Press.UPPER_DOWN, 0.03), (Press.UPPER, 0.05)],
        ),
        ("b" * 20 + "....", []),
        ("uuu" + "b" * 20 + "....", [(Press.UPPER_DOWN, 0.0)]),
        ("lll" + "b" * 20 + "....", [(Press.LOWER_DOWN, 0.0)]),
        ("bbb" + "uuu.....", []),
        ("bbb" + "lll" + "bbb" + "uuu" + "." * 10, []),
        ("bb." + "u" * 9, [(Press.UPPER_DOWN, 0.03), (Press.UPPER, 0.11)]),
        ("l" * 10 + "b" * 10 + "l" * 10 + ".", [(Press.LOWER_DOWN, 0.0), (Press.LOWER, 0.08)]),
        ("u" * 10 + "b" * 10 + "u" * 10 + ".", [(Press.UPPER_DOWN, 0.0), (Press.UPPER, 0.08)]),
        (
            "uu.ll.",
            [(Press.UPPER_DOWN, 0.0), (Press.UPPER, 0.02), (Press.LOWER_DOWN, 0.03), (Press.LOWER, 0.05)],
        ),
    ],
    ids=[
        "nothing pressed reports nothing",
        "a held lower button is reported at once and confirmed once after the window",
        "a short press is confirmed at release",
        "a held upper button is reported at once and confirmed once after the window",
        "two short presses are two",
        "both in one reading are a chord",
        "the lower following the upper is a chord, of which only the stop was reported",
        "the upper following the lower is a chord, of which only the stop was reported",
        "a chord let go finger by finger stays silent",
        "a finger that comes back during a chord stays silent",
        "a press after the chord was released counts",
        "a late second button adds nothing after the lower was confirmed",
        "a late second button adds nothing after the upper was confirmed",
        "one after the other is not a chord",
    ],
)
def test_buttons(script: str, expected: list[tuple[Press, float]]) -> None:
    assert play(script) == expected


def test_a_button_held_from_the_first_reading_does_not_count_until_released() -> None:
    assert play("l" * 20 + "." + "l" * 10, start_released=False)[0] == (Press.LOWER_DOWN, 0.21)


def test_forgetting_treats_a_held_button_as_not_pressed_until_released() -> None:
    arbiter = ButtonArbiter(WINDOW)
    arbiter.receive(HandInputs(), 0.0, 0.0)
    arbiter.receive(HandInputs(button_lower=True), 0.01, 0.01)
    arbiter.forget()
    assert arbiter.receive(HandInputs(button_lower=True), 0.02, 0.02) == []
    assert arbiter.due(1.0) == []
    arbiter.receive(HandInputs(), 1.1, 1.1)
    assert arbiter.receive(HandInputs(button_lower=True), 1.2, 1.2) == [Press.LOWER_DOWN]


def test_cancelling_drops_the_press_that_waits_and_wants_a_release() -> None:
    arbiter = ButtonArbiter(WINDOW)
    arbiter.receive(HandInputs(), 0.0, 0.0)
    arbiter.receive(HandInputs(button_lower=True), 0.01, 0.01)
    arbiter.cancel()
    assert arbiter.due(0.5) == []
    assert arbiter.receive(HandInputs(button_lower=True), 0.6, 0.6) == []


@pytest.mark.parametrize("stamp", [0.5, -math.inf, math.nan], ids=["overtaken", "none received", "not a number"])
def test_readings_without_a_current_stamp_are_passed_over(stamp: float) -> None:
    arbiter = ButtonArbiter(WINDOW)
    arbiter.receive(HandInputs(), 1.0, 1.0)
    assert arbiter.receive(HandInputs(button_lower=True), stamp, 1.1) == []
    assert arbiter.due(2.0) == []


def test_a_stamp_in_the_future_counts_as_now() -> None:
    arbiter = ButtonArbiter(WINDOW)
    arbiter.receive(HandInputs(), 1e9, 1.0)
    assert not arbiter.stale(1.1, 0.15)
    assert arbiter.stale(1.2, 0.15)
    assert arbiter.receive(HandInputs(button_lower=True), 1.3, 1.3) == [Press.LOWER_DOWN]
