"""The actions that controls are bound to: precision, locks, a dead man's switch. No control makes a target jump."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.bindings import HELD, Action, BindingSettings
from q2r2_control.errors import ConfigError
from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.teleop.gestures import HeldControls, travel
from q2r2_control.types import SIDES, HandInputs
from tests.teleop import hands
from tests.teleop.hands import ENGAGED, IDLE, LOST, PAUSED, PUSHED, STOPPED, Operator, assert_smooth, spoilt, waving


def engaged(**bindings: str) -> Operator:
    return hands.engaged(bindings=bindings)


def shift(driver: Operator, way: np.ndarray, turn: np.ndarray, duration: float = 1.0) -> list:
    """Move both hands by ``way`` [m] and ``turn`` [rad], and let them rest. Return the targets of all ticks."""
    start = dict(driver.hands)

    def move(t: float) -> dict[str, pin.SE3]:
        share = min(t / duration, 1.0)
        return {
            hand: pin.SE3(pin.exp3(share * turn) @ at.rotation, at.translation + share * way)
            for hand, at in start.items()
        }

    return driver.run(duration + 0.8, move)


WAY, TURN = np.array([0.1, -0.05, 0.08]), np.array([0.1, 0.3, -0.2])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("action", "position", "rotation"),
    [("precision", 0.25, 0.25), ("rotation_lock", 1.0, 0.0), ("translation_lock", 0.0, 1.0)],
)
@pytest.mark.parametrize("control", ["trigger", "stick_left"])
def test_a_held_control_scales_the_motion_and_its_press_and_release_make_no_target_jump(
    control: str, action: str, position: float, rotation: float
) -> None:
    driver = engaged(**{control: action})
    history = shift(driver, WAY, TURN)
    for held, shares in ((1.0, (position, rotation)), (0.0, (1.0, 1.0))):
        driver.held = {control: held}
        history += driver.run(0.1)
        before = driver.place()
        history += shift(driver, WAY, TURN)
        after = driver.place()
        np.testing.assert_allclose(after.translation - before.translation, shares[0] * WAY, atol=2e-4)
        np.testing.assert_allclose(pin.log3(after.rotation @ before.rotation.T), shares[1] * TURN, atol=1e-3)
    assert_smooth(history)


def test_controls_that_are_pressed_and_released_during_motion_make_no_target_jump() -> None:
    driver = engaged(grip="precision", trigger="rotation_lock", stick_up="translation_lock")
    wave = waving(driver, 0.2)
    history, random = [], np.random.default_rng(2)
    for turn in range(40):
        driver.held = {control: float(random.random() < 0.5) for control in ("grip", "trigger", "stick_up")}
        history += driver.run(0.05, lambda t, turn=turn: wave(t + 0.05 * turn))  # type: ignore[misc]
    assert_smooth(history)
    assert driver.states == ENGAGED


def test_if_the_control_for_precision_is_held_while_an_arm_is_engaged_the_arm_moves_precisely_at_once() -> None:
    driver = hands.operator(bindings={"grip": "precision"})
    driver.run(0.1)
    driver.held = {"grip": 1.0}
    driver.engage()
    before = driver.place()
    shift(driver, WAY, np.zeros(3))
    np.testing.assert_allclose(driver.place().translation - before.translation, 0.25 * WAY, atol=2e-4)


class TestADeadMan:
    BINDINGS: ClassVar[dict[str, str]] = {"lower": "none", "grip": "dead_man"}

    def driver(self) -> Operator:
        driver = hands.operator(bindings=self.BINDINGS)
        driver.run(0.1)
        assert driver.states == IDLE
        return driver

    def test_an_arm_is_engaged_while_its_dead_mans_switch_is_held_and_pauses_at_once_on_release(self) -> None:
        driver = self.driver()
        driver.held = {"grip": 1.0}
        driver.run(0.05)
        assert driver.states == ENGAGED
        shift(driver, WAY, TURN)
        driver.held = {}
        driver.tick(driver.samples())
        assert driver.states == PAUSED
        assert all(target.pose is None for target in driver.targets.values())
        assert {event.kind for event in driver.events} == {"dead_man_held", "dead_man_released"}
        assert not any(map(is_fault, driver.events))

    def test_after_a_fault_a_held_dead_mans_switch_engages_its_arm_only_after_a_release_and_a_new_press(self) -> None:
        driver = self.driver()
        driver.held = {"grip": 1.0}
        driver.run(0.05)
        driver.silent = set(SIDES)
        driver.run(0.3)
        assert driver.states == LOST
        driver.silent = set()
        driver.run(0.5)
        assert driver.states == LOST
        driver.held = {}
        driver.run(0.1)
        driver.held = {"grip": 1.0}
        driver.run(0.1)
        assert driver.states == ENGAGED

    @pytest.mark.parametrize("lost", [False, True])
    def test_a_dead_mans_switch_that_is_held_while_the_connection_starts_does_nothing(self, lost: bool) -> None:
        driver = hands.operator(bindings=self.BINDINGS)
        driver.held = {"grip": 1.0}
        driver.run(0.2)
        assert driver.states == IDLE
        if lost:
            driver.held = {}
            driver.run(0.1)
            driver.held = {"grip": 1.0}
            driver.run(0.1)
            assert driver.states == ENGAGED
            driver.teleop.connection_lost(driver.now)
            driver.run(0.3)
            assert driver.states == LOST

    @pytest.mark.parametrize("let_go", [False, True])
    def test_after_an_alignment_the_arms_follow_again_only_if_the_dead_mans_switch_is_still_held(
        self, let_go: bool
    ) -> None:
        driver = self.driver()
        driver.held = {"grip": 1.0}
        driver.run(0.05)
        driver.lower, driver.upper = set(SIDES), set(SIDES)
        driver.run(0.2)
        assert driver.states == {"left": "aligning", "right": "aligning"}
        driver.held = {} if let_go else driver.held
        driver.run(0.1)
        driver.lower, driver.upper = set(), set()
        driver.run(0.2)
        assert driver.states == (PAUSED if let_go else ENGAGED)

    def test_a_reading_that_is_not_finite_releases_a_dead_mans_switch(self) -> None:
        driver = self.driver()
        driver.held = {"grip": 1.0}
        driver.run(0.05)
        driver.alter = lambda received: spoilt(received, inputs=HandInputs(press_middle=float("nan")))
        driver.run(0.05)
        assert driver.states == PAUSED


def test_a_pedal_can_be_a_dead_mans_switch_and_a_held_knob_can_stop_the_arms() -> None:
    driver = hands.operator(bindings={"lower": "none", "device": {"pedal": "dead_man", "knob_hold": "stop"}})
    driver.run(0.1)
    for more, expected in (({"pedal": 1.0}, ENGAGED), ({}, PAUSED), ({"knob": 0.9}, PAUSED), ({"knob": 0.9}, STOPPED)):
        driver.alter = lambda received, more=more: spoilt(received, inputs=HandInputs(more=more))  # type: ignore[misc]
        driver.run(0.4)
        assert driver.states == expected


def test_a_control_that_trembles_about_its_threshold_counts_as_pressed_once_and_released_once() -> None:
    controls = HeldControls(BindingSettings(grip=Action.PRECISION))
    seen = []
    for value in (0.0, 0.55, 0.61, 0.45, 0.59, 0.41, 0.39, 0.55, 0.5, 0.59, 0.7):
        controls.receive(HandInputs(press_middle=value))
        seen.append(bool(controls.actions))
    assert seen == [False, False, True, True, True, True, False, False, False, False, True]


@pytest.mark.parametrize("control", HELD)
def test_a_fully_pushed_control_has_travel_1_and_all_other_controls_have_no_travel(control: str) -> None:
    inputs = HandInputs(**PUSHED[control])
    assert travel(control, inputs) == 1.0
    assert all(travel(other, inputs) <= 0.0 for other in HELD if other != control)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"upper": "pause_toggle"}, "lower and upper are both pause_toggle; allowed: one of them"),
        ({"grip": "dead_man"}, "lower is pause_toggle and grip is dead_man; allowed: one way to engage"),
        ({"lower": "none"}, "no control engages the arm; allowed: a control that is pause_toggle, or dead_man"),
        ({"lower": "none", "lower_hold": "pause_toggle"}, "pause_toggle, which must not wait; allowed: lower"),
        ({"upper": "stop"}, "upper is stop, and the headset's alignment presses it too; allowed: upper_hold,"),
        ({"upper": "precision"}, "upper is precision, which lasts; allowed: trigger, grip, stick_up,"),
        ({"stick_up": "gripper_analog"}, "stick_up is gripper_analog; allowed: trigger or grip"),
        ({"grip": "precision", "grip_hold": "home"}, "grip is precision and grip_hold is home; allowed: one of them"),
        ({"device": {"grip": "home"}}, "device.grip: a control of every headset; allowed: lower,"),
        (
            {"grip": "home", "device": {"pedal_hold": "home"}},
            "grip and device.pedal_hold are both home; allowed: one of",
        ),
        ({"grip": "gripper_analog"}, "upper is gripper_toggle and grip is gripper_analog; allowed: one of them"),
    ],
)
def test_bindings_that_are_ambiguous_or_engage_no_arm_are_refused(given: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        BindingSettings.model_validate(given)
    assert said in str(error.value)
