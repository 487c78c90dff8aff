"""Some arms sag: their tools are measured lower than commanded. If they are engaged, no tool and no command moves."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.teleop.hand_motion import MAX_OFFSET
from q2r2_control.types import SIDES, Array
from tests.teleop.hands import Operator, engaged, operator, waving

SAG = np.array([0.005, 0.0, -0.02])  # Measured position of a tool minus its commanded position [m].


def hanging(driver: Operator, by: Array = SAG) -> Operator:
    """Let all measured tools be ``by`` [m] away from their commands."""
    driver.commanded = {arm: pin.SE3(tool.rotation, tool.translation - by) for arm, tool in driver.tools.items()}
    return driver


def command(driver: Operator, arm: str = "left") -> Array:
    """Return the position (3,) of the target that the controller gets [m]."""
    asked = driver.targets[arm].command
    assert asked is not None
    return asked.translation


def target(driver: Operator) -> Array:
    return driver.place().translation


def test_the_target_begins_at_the_measured_tool_and_the_command_begins_at_its_last_position() -> None:
    driver = hanging(operator())
    assert driver.commanded is not None
    driver.engage()
    np.testing.assert_allclose(target(driver), driver.tools["left"].translation, atol=1e-9)
    np.testing.assert_allclose(command(driver), driver.commanded["left"].translation, atol=1e-9)
    driver.run(0.5, waving(driver))
    np.testing.assert_allclose(target(driver) - command(driver), SAG, atol=1e-12)


def test_if_the_tool_is_far_from_its_command_the_command_begins_at_the_measured_tool() -> None:
    driver = hanging(operator(), np.array([0.0, 1.01 * MAX_OFFSET[0], 0.0]))
    driver.engage()
    np.testing.assert_allclose(command(driver), driver.tools["left"].translation, atol=1e-9)


def test_each_engagement_uses_the_present_sag_and_changed_settings_do_not_alter_the_sag_in_use() -> None:
    driver = hanging(engaged())
    assert driver.targets["left"].offset is None
    changed = driver.settings.model_copy(update={"position_scale": 0.5})
    assert driver.teleop.change(changed, driver.now) is None
    driver.run(0.1)
    np.testing.assert_allclose(command(driver), target(driver), atol=1e-12)
    driver.press(*SIDES)
    driver.press(*SIDES)
    np.testing.assert_allclose(command(driver) - target(driver), -SAG, atol=1e-12)


def test_the_leash_is_measured_from_the_measured_tool_of_a_sagging_arm() -> None:
    for way in (0.2, -0.2):
        driver = hanging(operator(leash={"distance": 0.03}))
        driver.engage()
        driver.run(1.0, waving(driver, way))
        off = target(driver) - driver.tools["left"].translation
        np.testing.assert_allclose(off, (0.0, np.sign(way) * 0.03, 0.0), atol=1e-6)


def test_carrying_an_arm_that_was_never_engaged_makes_no_command_jump() -> None:
    driver = hanging(operator(bindings={"grip": "carry"}))
    assert driver.commanded is not None
    driver.engage("left")
    driver.push("grip")
    assert driver.states == {"left": "engaged", "right": "carried"}
    for arm in SIDES:
        np.testing.assert_allclose(command(driver, arm), driver.commanded[arm].translation, atol=1e-9)
