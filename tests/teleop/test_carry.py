"""One hand carries: it moves both tools as one rigid body. The tools keep their relative pose, and no target jumps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.types import SIDES, ArmTarget
from tests.teleop.hands import ENGAGED, PAUSED, Operator, assert_smooth, engaged, operator

BINDINGS = {"grip": "carry", "stick_down": "home", "stick_left": "stop"}
CARRYING = {"left": "engaged", "right": "carried"}


def carrying(*hands: str, **changes: object) -> Operator:
    """Return an operator who has engaged the arms of ``hands`` and whose left hand then moves both tools."""
    driver = operator(bindings=BINDINGS, **changes)
    driver.engage(*hands)
    driver.push("grip")
    assert driver.states == CARRYING
    return driver


def relation(targets: dict[str, ArmTarget]) -> pin.SE3:
    left, right = targets["left"].pose, targets["right"].pose
    assert left is not None
    assert right is not None
    return left.actInv(right)


def turning(driver: Operator, way: float = 0.2, angle: float = 0.6) -> Callable[[float], dict[str, pin.SE3]]:
    """Return a motion: the left hand moves and turns within a second, while the right hand waves independently."""
    left, right = (driver.hands[hand] for hand in SIDES)

    def move(t: float) -> dict[str, pin.SE3]:
        share = min(t, 1.0)
        turn = pin.exp3(np.array([0.0, 0.3 * angle * share, angle * share]))
        elsewhere = right.translation + 0.05 * np.sin([3.0 * t, 5.0 * t, 7.0 * t])
        return {
            "left": pin.SE3(turn @ left.rotation, left.translation + share * np.array([way, 0.1, -0.1])),
            "right": pin.SE3(pin.exp3(np.array([0.4 * np.sin(4.0 * t), 0.0, 0.0])) @ right.rotation, elsewhere),
        }

    return move


class TestBothTools:
    def test_carried_tools_keep_their_relative_pose_at_every_tick_and_turn_about_the_point_between_them(self) -> None:
        driver = carrying()
        before, start = relation(driver.targets), {arm: driver.place(arm) for arm in SIDES}
        for targets in driver.run(1.5, turning(driver)):
            assert relation(targets).isApprox(before, 1e-9)
        ways = [driver.place(arm).translation - start[arm].translation for arm in SIDES]
        np.testing.assert_allclose(np.mean(ways, axis=0), (0.2, 0.1, -0.1), atol=1e-3)
        turned = driver.place("right").rotation @ start["right"].rotation.T
        np.testing.assert_allclose(pin.log3(turned), (0.0, 0.18, 0.6), atol=5e-3)

    def test_carried_tools_do_not_jump_if_carrying_begins_during_motion(self) -> None:
        driver = engaged(bindings=BINDINGS)
        move = turning(driver)
        history = driver.run(0.4, move)
        driver.only, driver.held = "left", {"grip": 1.0}
        history += driver.run(0.6, lambda t: move(0.4 + t))
        assert driver.states == CARRYING
        assert_smooth(history)

    @pytest.mark.parametrize("hand", SIDES)
    def test_carried_tools_follow_the_hand_that_pressed_the_control_for_carrying(self, hand: str) -> None:
        driver = engaged(bindings=BINDINGS)
        driver.push("grip", hand)
        assert driver.states == {hand: "engaged", ("right" if hand == "left" else "left"): "carried"}
        assert [arm for arm, target in driver.targets.items() if target.hand is not None] == [hand]

    def test_carrying_may_begin_with_one_engaged_arm_and_its_start_moves_no_arm(self) -> None:
        driver = carrying("left")
        assert driver.place("right").isApprox(driver.tools["right"], 1e-6)

    def test_both_tools_are_held_back_if_one_arm_cannot_follow(self) -> None:
        driver = carrying()
        poses = {arm: driver.place(arm) for arm in SIDES}
        move = turning(driver, angle=0.0)
        for tick in range(1500):
            driver.hands |= move(0.001 * tick)
            driver.commanded = {"left": driver.place(), "right": poses["right"]}  # The other arm is stuck.
            driver.tick()
            for arm in SIDES:
                away = driver.place(arm).translation - poses[arm].translation
                assert np.linalg.norm(away) < 0.03 + (0.01 if arm == "right" else 0.0) + 1e-6
        assert driver.targets["left"].slip > 0.15

    @pytest.mark.parametrize(
        ("in_step", "top", "least", "greatest"),
        [(True, 0.5, 0.003, 0.011), (False, 0.5, -1e-9, 1e-9), (True, 0.401, 0.0009, 0.001 + 1e-9)],
        ids=["by poses of one moment", "not by those of two", "no farther than the box"],
    )
    def test_the_carried_target_is_shifted_so_that_lagging_tools_keep_their_relative_pose(
        self, in_step: bool, top: float, least: float, greatest: float
    ) -> None:
        driver = carrying(workspace={"right": {"x": [0.3, 0.7], "y": [-0.7, 0.7], "z": [0.3, top]}})
        driver.in_step = in_step
        right = driver.place("right")
        late = pin.SE3(right.rotation, right.translation - np.array([0.0, 0.0, 0.004]))
        driver.commanded = {"left": driver.place(), "right": late}
        driver.run(0.2)
        raised = driver.place("right").translation[2] - right.translation[2]
        assert least < raised < greatest

    def test_each_carried_tool_stays_in_its_workspace_box(self) -> None:
        box = {"x": [0.4, 0.6], "y": [-0.7, 0.7], "z": [0.35, 0.6]}
        driver = carrying(workspace={"right": box})
        history = driver.run(2.0, turning(driver))
        assert_smooth(history)
        for targets in history:
            right = targets["right"].pose
            assert right is not None
            assert right.translation[0] < 0.6 + 1e-9
            assert right.translation[2] > 0.35 - 1e-9
        assert relation(history[-1]).isApprox(relation(history[0]), 1e-9)


class TestItEnds:
    @pytest.mark.parametrize(
        "end",
        [
            pytest.param(lambda driver: driver.push("grip"), id="by the same control"),
            pytest.param(lambda driver: driver.push("grip", "right"), id="by the same control of the other hand"),
            pytest.param(lambda driver: driver.press("left"), id="by a pause"),
            pytest.param(lambda driver: driver.press("right"), id="by a pause of the other hand"),
        ],
    )
    def test_when_carrying_ends_both_arms_hold_until_they_are_engaged_again(
        self, end: Callable[[Operator], Any]
    ) -> None:
        driver = carrying()
        end(driver)
        assert driver.states == PAUSED
        assert not any(map(is_fault, driver.events))
        driver.assert_holds()
        driver.press(*SIDES)
        assert driver.states == ENGAGED

    def test_after_carrying_the_engaged_arm_has_its_own_leash_and_its_own_box_again(self) -> None:
        box = {"x": [0.3, 0.9], "y": [-0.7, 0.7], "z": [0.1, 0.8]}
        driver = carrying(workspace={"left": box, "right": box | {"x": [0.3, 0.51]}})
        driver.press("left")
        driver.press("left")
        assert driver.states == {"left": "engaged", "right": "paused"}
        held = driver.place()
        driver.commanded = {"left": held}  # The arm is stuck.
        driver.run(1.5, turning(driver, angle=0.0))
        away = driver.place().translation - held.translation
        assert 0.09 < np.linalg.norm(away) < 0.1 + 1e-6  # The distance is smaller if the hand has come back a little.

    @pytest.mark.parametrize("hand", SIDES)
    def test_an_alignment_ends_carrying_and_then_no_arm_moves_without_a_press(self, hand: str) -> None:
        driver = carrying()
        driver.lower, driver.upper = {hand}, {hand}
        driver.run(0.3)
        driver.lower, driver.upper = set(), set()
        driver.run(0.3)
        assert driver.states == PAUSED
        driver.assert_holds()

    @pytest.mark.parametrize("linked", [True, False])
    def test_carrying_ends_if_the_hand_that_moves_both_tools_has_a_fault(self, linked: bool) -> None:
        driver = carrying(linked=linked)
        driver.silent = {"left"}
        driver.run(0.3)
        assert driver.states == {"left": "lost", "right": "lost" if linked else "paused"}
        driver.assert_holds()

    def test_carrying_goes_on_if_the_other_controller_is_put_down(self) -> None:
        driver = carrying()
        driver.silent = {"right"}
        history = driver.run(1.0, turning(driver))
        assert driver.states == CARRYING
        assert all(targets["right"].pose is not None for targets in history)

    def test_a_stop_and_a_lost_connection_end_carrying(self) -> None:
        driver = carrying()
        driver.push("stick_left", "right")
        assert driver.states == {"left": "stopped", "right": "stopped"}
        driver = carrying()
        driver.teleop.connection_lost(driver.now)
        driver.run(0.01)
        assert driver.states == {"left": "lost", "right": "lost"}


class TestItDoesNotBegin:
    def test_carrying_is_refused_for_an_arm_that_is_not_engaged(self) -> None:
        driver = operator(bindings=BINDINGS)
        driver.engage("right")
        driver.push("grip")
        assert driver.states == {"left": "idle", "right": "engaged"}
        assert driver.refusals() == {"not_carried: engage_first"}

    def test_carrying_is_refused_if_a_tool_cannot_follow_its_target(self) -> None:
        driver = engaged(bindings=BINDINGS)
        driver.commanded = {arm: driver.place(arm) for arm in SIDES}
        driver.run(1.0, turning(driver))
        driver.push("grip")
        assert driver.states == ENGAGED
        assert driver.refusals() == {"not_carried: tool_held_up"}

    def test_homing_is_refused_while_the_arms_carry(self) -> None:
        driver = carrying()
        driver.push("stick_down")
        assert driver.states == CARRYING
        assert driver.refusals() == {"not_homing: carrying"}
