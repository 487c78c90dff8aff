"""Targets never leave their workspace box. They come back from a side of the box as soon as the hand comes back."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import WorkspaceSettings
from q2r2_control.quaternions import IDENTITY
from q2r2_control.teleop.leash import Workspace
from q2r2_control.types import SIDES
from tests.teleop.hands import TICK, Operator, assert_smooth, engaged, operator

# Workspace around the left tool, which is at (0.5, 0.4, 0.4) [m]. See ``Operator.tools``.
BOX = {"x": [0.4, 0.65], "y": [0.3, 0.6], "z": [0.3, 0.5]}


def shift(driver: Operator, way: tuple[float, float, float], duration: float) -> list[np.ndarray]:
    """Move both hands by ``way`` [m] at constant speed, and let them rest. Return the left target's positions [m]."""
    start = dict(driver.hands)

    def move(t: float) -> dict[str, pin.SE3]:
        share = min(t / duration, 1.0)
        return {hand: pin.SE3(at.rotation, at.translation + share * np.array(way)) for hand, at in start.items()}

    history = driver.run(duration + 0.5, move)
    assert_smooth(history)
    return [targets["left"].pose.translation for targets in history if targets["left"].pose is not None]


def test_a_target_never_leaves_its_box_and_comes_back_with_the_hand_at_once() -> None:
    driver = engaged(workspace={"left": BOX})
    out = shift(driver, (0.3, 0.0, 0.0), 1.0)
    assert max(position[0] for position in out) <= 0.65
    assert out[-1][0] > 0.64  # The target may be a little inside, because the filter overshoots when the hand stops.
    assert driver.targets["left"].slip > 0.1
    assert driver.targets["right"].slip == 0.0
    back = shift(driver, (-0.1, 0.05, -0.05), 0.5)
    np.testing.assert_allclose(back[-1] - out[-1], (-0.1, 0.05, -0.05), atol=1e-3)


def test_the_target_of_a_tool_outside_its_box_does_not_jump_and_may_only_move_inwards() -> None:
    driver = operator(workspace={"left": BOX | {"x": [0.6, 0.8]}})
    driver.engage()
    np.testing.assert_allclose(driver.place().translation, driver.tools["left"].translation, atol=1e-6)
    out = shift(driver, (-0.1, 0.0, 0.0), 0.5)
    assert min(position[0] for position in out) > 0.5 - 1e-6
    assert out[-1][0] < 0.504  # The tolerance is the overshoot of the filter when the hand stops.
    assert shift(driver, (0.2, 0.0, 0.0), 0.5)[-1][0] == pytest.approx(0.7, abs=5e-3)


@pytest.mark.parametrize("at", [0.6499, 0.66])
def test_a_target_at_a_side_of_the_box_does_not_drift_while_the_hand_trembles(at: float) -> None:
    workspace = Workspace(WorkspaceSettings.model_validate(BOX))
    position, way = (at, 0.4, 0.4), 0.0
    assert workspace.hold((position, IDENTITY)) is None
    random = np.random.default_rng(0)
    for tick in range(5000):
        wanted = 0.5e-3 * np.sin(2.0 * np.pi * 10.0 * tick * TICK) + random.normal(0.0, 2e-5)
        asked = position[0] + wanted - way, 0.4, 0.4
        way, held = wanted, workspace.hold((asked, IDENTITY))
        position = asked if held is None else held
        assert abs(position[0] - at) < 1.5e-3


def test_each_axis_has_its_own_scale_and_a_scale_of_0_locks_the_axis() -> None:
    driver = engaged(position_scale=0.5, axis_scales=(1.0, 2.0, 0.0))
    before = driver.tools["left"].translation
    after = shift(driver, (0.1, -0.05, 0.08), 1.0)[-1]
    np.testing.assert_allclose(after - before, (0.05, -0.05, 0.0), atol=1e-3)
    assert all(driver.targets[arm].slip == 0.0 for arm in SIDES)
