"""Each gesture is reported once, and is distinguished from the alignment chord."""

from __future__ import annotations

import pytest

from q2r2_control.config.bindings import HELD, Gesture
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason
from q2r2_control.teleop.gestures import GestureRecognizer, Press
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HandInputs
from tests.teleop.hands import PUSHED

WINDOW = 0.075  # The window ends between two readings, so that rounding does not matter.
LOWER_DOWN, LOWER = Press("lower", Gesture.DOWN), Press("lower", Gesture.TAP)
UPPER_DOWN, UPPER = Press("upper", Gesture.DOWN), Press("upper", Gesture.TAP)


def recognizer(**bindings: str) -> GestureRecognizer:
    given = {"chord_window": WINDOW, "hold_time": 0.595, "bindings": bindings}
    return GestureRecognizer(TeleopSettings.model_validate(given))


def play(
    script: str, bindings: dict[str, str] | None = None, period: float = 0.01, start_released: bool = True
) -> list[tuple[Press, float]]:
    """Return the presses that are reported, with the time of each report [s].

    Each letter of ``script`` is a reading of the buttons that are held: . none, u upper, l lower, b both.
    """
    gestures = recognizer(**(bindings or {}))
    found, t = [], 0.0
    for letter in ("." if start_released else "") + script:
        inputs = HandInputs(button_upper=letter in "ub", button_lower=letter in "lb")
        reported = gestures.receive(inputs, t) + gestures.due(t)
        found += [(press, round(t - period * start_released, 6)) for press in reported]
        t += period
    return found


HOLDS = {"lower_hold": "home"}
HELD_FOR = Press("lower", Gesture.HOLD)
TWO_PRESSES = [(UPPER_DOWN, 0.0), (UPPER, 0.02), (UPPER_DOWN, 0.03), (UPPER, 0.05)]
ONE_AND_THE_OTHER = [(UPPER_DOWN, 0.0), (UPPER, 0.02), (LOWER_DOWN, 0.03), (LOWER, 0.05)]
LONG = [(LOWER_DOWN, 0.0), (LOWER, 0.08)]
SCRIPTS: dict[str, tuple[dict[str, str], str, list[tuple[Press, float]]]] = {
    "a held button is reported at once and confirmed once after the window": ({}, "l" * 12, LONG),
    "a short press is confirmed at release": ({}, "lll.....", [(LOWER_DOWN, 0.0), (LOWER, 0.03)]),
    "two short presses are two": ({}, "uu.uu.", TWO_PRESSES),
    "both in one reading are a chord": ({}, "b" * 20 + "....", []),
    "of a chord that begins with one only the stop is reported": ({}, "uuu" + "b" * 20 + "....", [(UPPER_DOWN, 0.0)]),
    "a chord let go finger by finger stays silent": ({}, "bbb" + "uuu.....", []),
    "a finger that comes back during a chord stays silent": ({}, "bbb" + "lll" + "bbb" + "uuu" + "." * 10, []),
    "a press after the chord was released counts": ({}, "bb." + "u" * 9, [(UPPER_DOWN, 0.03), (UPPER, 0.11)]),
    "a late second button adds nothing": ({}, "l" * 10 + "b" * 10 + "l" * 10 + ".", LONG),
    "one after the other is not a chord": ({}, "uu.ll.", ONE_AND_THE_OTHER),
    "held long enough is a hold, no tap at its end": (HOLDS, "l" * 80 + "...", [(LOWER_DOWN, 0.0), (HELD_FOR, 0.6)]),
    "let go before is a tap": (HOLDS, "l" * 40 + "." * 60, [(LOWER_DOWN, 0.0), (LOWER, 0.4)]),
    "a chord is no hold": (HOLDS, "l" * 40 + "b" * 60, [(LOWER_DOWN, 0.0)]),
}


@pytest.mark.parametrize(("bindings", "script", "expected"), SCRIPTS.values(), ids=SCRIPTS)
def test_each_gesture_is_reported_once_at_the_expected_time(
    bindings: dict[str, str], script: str, expected: list[tuple[Press, float]]
) -> None:
    assert play(script, bindings) == expected


def test_a_button_that_is_held_at_the_first_reading_counts_only_after_its_release() -> None:
    assert play("l" * 20 + "." + "l" * 10, start_released=False)[0] == (LOWER_DOWN, 0.21)


def test_a_control_that_is_held_since_the_first_reading_is_reported_once_after_a_second() -> None:
    found = recognizer()
    for step in range(30):
        now = 0.1 * step
        found.receive(HandInputs(button_lower=True), now)
        told = found.take_stuck(now)
        assert told == (Reason.of(TeleopReason.CONTROLS_HELD, controls=["lower"]) if step == 11 else None), now
    found.forget()
    found.receive(HandInputs(), 3.0)
    found.receive(HandInputs(button_lower=True), 3.1)
    assert found.take_stuck(9.0) is None, "it was pressed"


def test_a_press_of_exactly_the_hold_time_is_a_hold() -> None:
    settings = {"chord_window": WINDOW, "hold_time": 0.5, "bindings": HOLDS}
    gestures = GestureRecognizer(TeleopSettings.model_validate(settings))
    for stamp, held in ((-1.0, False), (0.0, True), (0.5, False)):
        reported = gestures.receive(HandInputs(button_lower=held), stamp)
    assert reported == [HELD_FOR]


def test_cancelling_drops_all_presses_except_a_stop_whose_button_is_held() -> None:
    gestures = recognizer(upper_hold="stop", lower_hold="home")
    gestures.receive(HandInputs(), 0.0)
    gestures.receive(HandInputs(button_upper=True), 0.01)
    gestures.cancel()
    assert gestures.due(0.5) == []
    assert gestures.due(0.62) == [Press("upper", Gesture.HOLD)]
    gestures.receive(HandInputs(), 1.0)
    gestures.receive(HandInputs(button_upper=True), 1.1)
    gestures.cancel()
    assert gestures.receive(HandInputs(), 1.2) == []  # The press was too short for a stop, so nothing is reported.
    gestures.receive(HandInputs(button_lower=True), 1.3)
    gestures.cancel()
    assert gestures.due(3.0) == gestures.receive(HandInputs(button_lower=True), 3.1) == []


def test_readings_that_arrive_late_and_together_are_timed_by_their_own_stamps() -> None:
    gestures = recognizer(lower_hold="home")
    found = []
    for stamp, inputs in ((0.0, HandInputs()), (0.1, HandInputs(button_lower=True)), (0.8, HandInputs())):
        found += gestures.receive(inputs, stamp)
    assert found == [LOWER_DOWN, HELD_FOR]


@pytest.mark.parametrize("control", HELD)
def test_taps_of_triggers_and_sticks_are_reported_at_once_because_no_chord_contains_them(control: str) -> None:
    gestures = recognizer(**{control: "home"})
    # The control is already held at the first reading, so it does not count as pressed.
    assert gestures.receive(HandInputs(**PUSHED[control]), 0.0) + gestures.due(1.0) == []
    gestures.receive(HandInputs(), 1.1)
    assert gestures.receive(HandInputs(**PUSHED[control]), 1.2) == [Press(control, Gesture.DOWN)]
    assert gestures.due(1.2) == [Press(control, Gesture.TAP)]
    assert gestures.receive(HandInputs(), 1.3) + gestures.due(2.0) == []


def test_a_control_without_an_action_or_with_a_lasting_action_makes_no_gesture() -> None:
    gestures = recognizer(grip="precision")
    gestures.receive(HandInputs(), 0.0)
    pressed = HandInputs(press_index=1.0, press_middle=1.0, thumb_stick_vertical=1.0)
    assert gestures.receive(pressed, 0.1) + gestures.due(1.0) == []
