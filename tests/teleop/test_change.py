"""Settings that change while the arms move: no target jumps, and some changes are refused until the arms hold."""

from __future__ import annotations

import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.types import SIDES
from tests.support.reasons import kinds
from tests.teleop.hands import ENGAGED, Operator, assert_smooth, engaged, waving

BOX = {"x": [0.3, 0.7], "y": [0.2, 0.6], "z": [0.2, 0.6]}
CHANGES = {
    "scales": {"position_scale": 0.3, "rotation_scale": 0.5, "axis_scales": (1.0, 0.5, 2.0)},
    "rotation frame": {"rotation_frame": "tool"},
    "filter": {"filter": {"smoothing_delay": 0.1, "interpolation_delay": 0.05}},
    "leash": {"leash": {"distance": 0.05}},
    "workspace": {"workspace": {"left": BOX}},
}


def settings(driver: Operator, **changes: object) -> TeleopSettings:
    return TeleopSettings.model_validate(driver.settings.model_dump() | changes)


@pytest.mark.parametrize("changes", CHANGES.values(), ids=CHANGES)
def test_if_the_settings_of_an_arm_change_during_motion_the_arm_goes_on_without_a_jump(
    changes: dict[str, object],
) -> None:
    driver = engaged()
    move = waving(driver)
    history = driver.run(0.4, move)
    assert driver.teleop.change(settings(driver, **changes), driver.now) is None
    history += driver.run(0.6, lambda t: move(0.4 + t))
    assert driver.states == ENGAGED
    assert_smooth(history)


@pytest.mark.parametrize(
    "changes",
    [{"stance": "mirror"}, {"axes": ("+y", "-x", "+z")}, {"bindings": {"grip": "home"}}, {"hold_time": 1.0}],
    ids=["stance", "axes", "bindings", "hold_time"],
)
def test_a_change_of_stance_axes_or_controls_is_refused_until_both_arms_hold(changes: dict[str, object]) -> None:
    driver = engaged()
    refusal = driver.teleop.change(settings(driver, **changes), driver.now)
    assert kinds(refusal) == "arms_must_hold"
    assert driver.teleop.settings == driver.settings
    driver.press(*SIDES)
    assert driver.teleop.change(settings(driver, **changes), driver.now) is None
    driver.run(0.3)
    driver.press(*SIDES)
    assert driver.states == ENGAGED


def test_each_hand_drives_the_other_arm_after_a_change_of_stance() -> None:
    driver = engaged()
    driver.press(*SIDES)
    assert driver.teleop.change(settings(driver, stance="mirror"), driver.now) is None
    assert [driver.teleop.hand_of(arm) for arm in SIDES] == ["right", "left"]
    driver.run(0.2)
    driver.press("left")
    assert driver.states == {"left": "paused", "right": "engaged"}


def test_a_press_that_began_before_a_change_of_stance_engages_no_arm() -> None:
    driver = engaged()
    driver.press(*SIDES)
    driver.lower = {"left"}
    driver.run(0.03)
    assert driver.teleop.change(settings(driver, stance="mirror"), driver.now) is None
    driver.lower = set()
    driver.run(0.3)
    assert driver.states == {"left": "paused", "right": "paused"}
