"""A press can stop both arms or move them home. A gripper can follow a trigger."""

from __future__ import annotations

import math

import numpy as np
import pytest

from q2r2_control.events import CommonReason, Reason
from q2r2_control.teleop.arm_states import is_fault
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, HandInputs
from tests.support.reasons import kinds
from tests.teleop import hands
from tests.teleop.hands import ENGAGED, HOMING, IDLE, LOST, PAUSED, STOPPED, Operator, spoilt, waving

BINDINGS = {"grip": "stop", "stick_down": "home"}


def engaged(**bindings: str) -> Operator:
    return hands.engaged(bindings=bindings or BINDINGS)


class TestAStop:
    def test_a_stop_stops_both_arms_at_the_first_sample_with_the_press(self) -> None:
        driver = engaged()
        driver.run(0.3, waving(driver))
        driver.only, driver.held = "right", {"grip": 1.0}
        driver.tick(driver.samples())
        assert driver.states == STOPPED
        assert all(target.pose is None for target in driver.targets.values())
        assert not any(map(is_fault, driver.events))

    def test_after_a_stop_no_arm_moves_until_the_stop_is_ended_and_a_press_engages_the_arm(self) -> None:
        driver = engaged()
        driver.push("grip")
        driver.push("stick_down")
        assert driver.states == STOPPED
        driver.press(*SIDES)
        driver.press(*SIDES, button="upper")
        assert driver.states == STOPPED
        assert driver.refusals() == {"not_engaged: stopped"}
        assert [driver.targets[arm].gripper for arm in SIDES] == [1.0, 1.0]
        driver.assert_holds()
        driver.push("grip", "right")
        assert driver.states == PAUSED
        driver.assert_holds()
        driver.press(*SIDES)
        assert driver.states == ENGAGED

    def test_a_stop_is_carried_out_before_all_other_presses_of_the_same_time(self) -> None:
        driver = engaged()
        driver.lower, driver.upper = {"left"}, {"left"}
        driver.held, driver.only = {"grip": 1.0, "stick_down": 1.0}, "right"
        driver.tick(driver.samples())
        assert driver.states == STOPPED
        driver.run(0.3)
        driver.lower, driver.upper, driver.held = set(), set(), {}
        driver.run(0.3)
        assert driver.states == STOPPED

    def test_resetting_one_arm_ends_the_stop_of_both_arms(self) -> None:
        driver = engaged()
        driver.push("grip")
        driver.teleop.reset(driver.now, "left", Reason(TeleopReason.RESET_SERVICE))
        assert driver.states == PAUSED

    def test_a_stop_whose_button_is_held_is_carried_out_even_if_a_fault_comes_during_the_hold(self) -> None:
        driver = engaged(upper_hold="stop")
        driver.upper = {"left"}
        driver.run(0.3)
        driver.teleop.pause(driver.now, Reason(TeleopReason.TOOL_UNKNOWN))
        assert driver.states == LOST
        driver.run(0.5)
        assert driver.states == STOPPED
        assert driver.targets["left"].gripper == 1.0


class TestTheWayHome:
    def test_either_hand_can_send_both_arms_home_and_the_caller_ends_the_motion(self) -> None:
        driver = engaged()
        driver.push("stick_down", "right")
        assert driver.states == HOMING
        assert driver.teleop.homing
        driver.assert_holds()  # The hands drive no arm.
        driver.teleop.end_homing(driver.now, Reason(CommonReason.HOMING_ARRIVED))
        driver.run(0.1)
        assert driver.states == PAUSED
        assert {event.kind for event in driver.events[-2:]} == {CommonReason.HOMING_ARRIVED}
        assert not any(map(is_fault, driver.events))
        driver.press(*SIDES)
        assert driver.states == ENGAGED

    def test_homing_is_refused_only_if_a_reason_forbids_it_for_the_arm_whose_hand_requests_it(self) -> None:
        for blocked, states in (("left", PAUSED), ("right", HOMING)):
            driver = engaged()
            driver.press(*SIDES)
            driver.obstacles = {blocked: Reason(TeleopReason.TOOL_UNKNOWN)}
            driver.push("stick_down", "left")
            assert driver.states == states

    @pytest.mark.parametrize("hand", SIDES)
    @pytest.mark.parametrize("control", ["lower", "upper", "stick_down"])
    def test_any_press_ends_the_motion_home_and_has_no_other_effect(self, control: str, hand: str) -> None:
        driver = engaged()
        driver.push("stick_down")
        if control in ("lower", "upper"):
            driver.press(hand, button=control)
        else:
            driver.push(control, hand)
        assert driver.states == PAUSED
        assert [driver.targets[arm].gripper for arm in SIDES] == [1.0, 1.0]

    def test_homing_ends_with_a_fault_only_if_the_hand_that_requested_it_is_lost(self) -> None:
        driver = engaged()
        driver.push("stick_down")
        driver.silent = {"right"}
        driver.run(0.4)
        assert driver.states == HOMING
        driver.silent = set(SIDES)
        driver.run(0.2)
        assert driver.states == LOST
        assert {kinds(event.reason) for event in driver.events[-2:]} == {"homing_fault: pose_silent"}

    def test_homing_that_a_program_requested_needs_no_hand(self) -> None:
        driver = hands.operator(bindings=BINDINGS)
        driver.silent = set(SIDES)
        driver.run(0.3)
        driver.teleop.home(driver.now)
        driver.run(0.3)
        driver.teleop.connection_lost(driver.now)
        driver.run(0.3)
        assert driver.states == HOMING
        driver.silent = set()
        driver.run(0.3)
        driver.press("left")
        assert driver.states == PAUSED

    def test_homing_is_refused_if_the_hand_that_requests_it_has_no_pose(self) -> None:
        driver = hands.operator(bindings=BINDINGS)
        driver.alter = lambda received: spoilt(received, pose_stamp=-math.inf)
        driver.run(0.3)
        driver.push("stick_down")
        assert driver.states == IDLE
        assert driver.refusals() == {"not_homing: pose_silent"}


class TestAGripperThatFollowsATrigger:
    def driver(self, **changes: object) -> Operator:
        driver = hands.operator(bindings={"upper": "none", "trigger": "gripper_analog"}, **changes)
        driver.only = "left"
        driver.run(0.1)
        return driver

    def test_a_gripper_closes_as_far_as_the_trigger_is_pushed_and_opens_no_faster_than_the_setting(self) -> None:
        driver = self.driver(gripper_speed=2.0)
        for pressed, opening in ((0.5, 0.5), (1.0, 0.0), (0.275, 0.75), (0.0, 1.0)):
            driver.held = {"trigger": pressed}
            openings = [targets["left"].gripper for targets in driver.run(0.5)]
            assert np.abs(np.diff(openings)).max() <= 2.0 * 0.001 + 1e-9
            assert openings[-1] == pytest.approx(opening, abs=1e-9)
            assert driver.targets["right"].gripper == 1.0

    def test_a_gripper_does_not_tremble_with_the_trigger(self) -> None:
        driver = self.driver()
        random, seen = np.random.default_rng(0), set()
        driver.held = {"trigger": 0.5}
        driver.run(0.4)
        for _ in range(50):
            driver.held = {"trigger": 0.5 + random.uniform(-0.008, 0.008)}
            driver.run(0.02)
            seen.add(driver.targets["left"].gripper)
        assert len(seen) == 1

    def test_after_a_reconnection_a_gripper_moves_only_when_the_trigger_has_reached_the_grippers_opening(self) -> None:
        driver = self.driver()
        driver.held = {"trigger": 0.725}
        driver.run(0.4)
        assert driver.targets["left"].gripper == pytest.approx(0.25)
        driver.teleop.connection_lost(driver.now)
        driver.held = {}
        driver.run(0.4)
        driver.held = {"trigger": 0.5}
        driver.run(0.4)
        assert driver.targets["left"].gripper == pytest.approx(0.25)
        driver.held = {"trigger": 0.9}
        driver.run(0.4)
        assert driver.targets["left"].gripper == pytest.approx(1.0 - 0.85 / 0.9)

    def test_a_reading_that_is_not_finite_leaves_a_gripper_unchanged(self) -> None:
        driver = self.driver()
        driver.held = {"trigger": 0.5}
        driver.run(0.4)
        driver.alter = lambda received: spoilt(received, inputs=HandInputs(press_index=math.nan))
        driver.run(0.2)
        assert driver.targets["left"].gripper == pytest.approx(0.5)

    def test_the_gripper_closes_and_opens_fully_although_the_last_motion_of_the_trigger_is_small(self) -> None:
        driver = self.driver()
        for nearly, pressed, opening in ((0.94, 0.96, 0.0), (0.06, 0.04, 1.0)):
            driver.held = {"trigger": nearly}
            driver.run(1.0)
            driver.held = {"trigger": pressed}
            driver.run(0.1)
            assert driver.targets["left"].gripper == opening
