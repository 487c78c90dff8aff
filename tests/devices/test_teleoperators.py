"""Hands of teleoperators and of rate devices, tested without lerobot. tests/lerobot/test_devices.py uses lerobot."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest
from q2r2_devices import reading, teleoperators
from q2r2_devices.rate import SILENCE, RateHand, RateReading

from q2r2_control import Config, ConfigError, HandInputs, HandSample, InputError
from q2r2_control.config.yaml_text import read_yaml
from q2r2_control.inputs import adapted, make_input
from tests.devices.mice import until
from tests.support.modules import blocks_of

Cell = Callable[..., Config]
GAMEPAD = {"teleoperator": {"type": "gamepad"}}


def test_if_lerobot_is_not_installed_one_line_says_how_to_install_it(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(
        InputError, match=r"^input_settings.lerobot.right: lerobot is not installed; allowed: make lerobot$"
    ):
        make_input("lerobot", cell("lerobot", right=GAMEPAD)).start()


def test_a_cell_without_a_hand_or_with_a_wrong_setting_is_refused(cell: Cell) -> None:
    with pytest.raises(ConfigError, match=r"^input_settings.lerobot: no hand; allowed: a hand, as right: {teleop"):
        make_input("lerobot", cell("lerobot", pedal="/dev/input/event7"))
    with pytest.raises(ConfigError, match=r"right.teleoperator: missing"):
        make_input("lerobot", cell("lerobot", right={}))


def test_one_teleoperator_for_both_hands_is_refused(cell: Cell) -> None:
    told = (
        r"^input_settings.lerobot.right.teleoperator: the same as of the left hand; allowed: another one for each hand$"
    )
    with pytest.raises(ConfigError, match=told):
        make_input("lerobot", cell("lerobot", left=GAMEPAD, right=GAMEPAD))
    left, right = ({"teleoperator": {"type": "so101_leader", "port": "/dev/ttyACM0", "id": hand}} for hand in "lr")
    with pytest.raises(ConfigError, match=r"right.teleoperator.port = /dev/ttyACM0: the same as of the left hand"):
        make_input("lerobot", cell("lerobot", left=left, right=right))
    make_input("lerobot", cell("lerobot", left=left, right=GAMEPAD))


def test_the_control_grip_is_a_dead_mans_switch_whatever_the_bindings_of_the_cell_say(cell: Cell) -> None:
    bindings = adapted("lerobot", cell("lerobot", right=GAMEPAD)).teleop.bindings
    assert {binding.control: binding.action for binding in bindings.bound()} == {
        "trigger": "gripper_analog",
        "grip": "dead_man",
    }


class Gamepad:
    """A teleoperator with the methods of lerobot's gamepad. ``get_action`` returns the attribute ``action``."""

    name, is_connected = "gamepad", True
    action_features: ClassVar = {"names": {"delta_x": 0, "delta_y": 1, "delta_z": 2, "gripper": 3}}

    def __init__(self) -> None:
        self.action: dict[str, float] = {"delta_x": 1.0, "delta_y": 0.0, "delta_z": 0.0, "gripper": 1}

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def get_action(self) -> dict[str, float]:
        return self.action

    def get_teleop_events(self) -> dict[Any, bool]:
        return {}


def test_a_gamepad_that_sends_nan_is_lost_and_its_hand_moves_on_from_the_same_place(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "_RETRY", 0.001)
    gamepad, lines = Gamepad(), list[str]()
    monkeypatch.setattr(teleoperators, "_made", lambda settings: gamepad)
    source = make_input("lerobot", cell("lerobot", right=GAMEPAD), say=lines.append)
    source.start()

    def samples() -> list[HandSample]:
        return source.poll(time.monotonic())

    until(lambda: bool(samples()))
    gamepad.action = gamepad.action | {"delta_y": np.nan}
    until(lambda: len(lines) > 1)
    assert lines[1].startswith("input_settings.lerobot.right: lost, delta_y = nan: allowed: a finite number; it is")
    samples()
    gamepad.action = gamepad.action | {"delta_y": 0.0}
    found: list[HandSample] = []

    def moves() -> bool:
        found.extend(samples())
        return bool(found)

    until(moves)
    assert np.isfinite(found[-1].position).all()
    source.close()


FAST = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.5])


def test_a_rate_hand_integrates_its_velocity_in_axes_that_do_not_turn_with_it() -> None:
    hand = RateHand("left")
    for step in range(101):
        samples = hand.poll([RateReading(FAST, HandInputs())], 0.02 * step)
    np.testing.assert_allclose(samples[-1].position, (0.2, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(samples[-1].quaternion, (0.0, 0.0, np.sin(0.5), np.cos(0.5)), atol=1e-12)


def test_without_readings_a_moving_hand_stops_and_has_no_samples_but_a_resting_hand_still_has_samples() -> None:
    hand = RateHand("left")
    hand.poll([RateReading(FAST, HandInputs())], 0.0)
    hand.poll([], SILENCE / 2.0)
    assert hand.poll([], SILENCE - 0.01)
    assert not hand.poll([], SILENCE + 0.01)
    assert not hand.poll([], 10.0)
    (after,) = hand.poll([RateReading(np.zeros(6), HandInputs())], 10.01)
    np.testing.assert_allclose(after.position, (0.1 * (SILENCE - 0.01), 0.0, 0.0), atol=1e-12)
    assert hand.poll([], 20.0)


def test_a_tap_that_is_shorter_than_the_period_of_the_samples_is_not_lost() -> None:
    hand = RateHand("left")
    hand.poll([RateReading(np.zeros(6), HandInputs())], 0.0)
    pressed, released = (RateReading(np.zeros(6), HandInputs(button_lower=held)) for held in (True, False))
    assert [sample.inputs.button_lower for sample in hand.poll([pressed, released], 0.001)] == [True, False]


def test_after_a_gap_between_two_polls_the_hand_moves_for_at_most_a_tenth_of_a_second() -> None:
    hand = RateHand("left")
    hand.poll([RateReading(FAST, HandInputs())], 0.0)
    (sample,) = hand.poll([RateReading(FAST, HandInputs())], 0.14)
    np.testing.assert_allclose(sample.position, (0.01, 0.0, 0.0), atol=1e-12)


def test_a_hand_that_was_lost_has_samples_again_in_a_run_whose_clock_begins_anew() -> None:
    hand, rests = RateHand("left"), RateReading(np.zeros(6), HandInputs())
    assert hand.poll([rests], 1000.0)
    assert hand.poll([None, rests], 0.0)


def test_a_hand_does_not_move_back_if_the_clock_goes_back() -> None:
    hand = RateHand("left")
    hand.poll([RateReading(FAST, HandInputs())], 5.0)
    (sample,) = hand.poll([None, RateReading(FAST, HandInputs())], 4.0)
    np.testing.assert_array_equal(sample.position, np.zeros(3))


def test_the_settings_in_the_docs_are_accepted(cell: Cell) -> None:
    shown = [block for text in blocks_of("docs/headset.md", "yaml") for block in [read_yaml(text)]]
    given = {name: its for block in shown for name, its in block.get("input_settings", {}).items()}
    assert sorted(given) == ["lerobot", "spacemouse"]
    for name, its in given.items():
        assert {*its} >= {"left", "right"}
        make_input(name, cell(name, **its))
