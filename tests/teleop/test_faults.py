"""Faults and invalid input stop the arms. Only a new press engages the arms again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.events import Reason
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, HandSample
from tests.support.reasons import kinds
from tests.teleop.hands import (
    ENGAGED,
    IDLE,
    LOST,
    assert_smooth,
    engaged,
    operator,
    pose,
    sample,
    spoilt,
    waving,
)

FAULTS: dict[str, Callable[[HandSample], HandSample]] = {
    "pose_silent": lambda s: spoilt(s, pose_stamp=10.29),
    "inputs_silent": lambda s: spoilt(s, inputs_stamp=10.29),
    "pose_unusable": lambda s: spoilt(s, position=np.array([np.nan, 0.0, 0.0])),
    "hand_jumped": lambda s: spoilt(s, position=s.position + 1.0),
    "hand_rotation_jumped": lambda s: spoilt(s, quaternion=np.array([1.0, 0.0, 0.0, 0.0])),
    "pose_without_stamp": lambda s: spoilt(s, pose_stamp=math.nan),
}


@pytest.mark.parametrize("linked", [True, False], ids=["linked", "each for itself"])
@pytest.mark.parametrize("reason", list(FAULTS))
def test_a_fault_of_the_left_hand_stops_the_left_arm_and_a_linked_right_arm_until_a_press(
    reason: str, linked: bool
) -> None:
    driver = engaged(linked=linked)
    driver.alter = lambda s: FAULTS[reason](s) if s.hand == "left" else s
    history = driver.run(0.3, waving(driver))
    assert_smooth(history)
    assert driver.states == (LOST if linked else {"left": "lost", "right": "engaged"})
    last = [event for event in driver.events if event.destination == "lost"]
    assert last[0].kind == reason
    assert [event.arm for event in last] == (["left", "right"] if linked else ["left"])
    driver.alter = lambda s: s
    if linked:
        driver.assert_holds()
    driver.press("left")
    assert driver.states["left"] == "engaged"


@pytest.mark.parametrize("linked", [True, False], ids=["linked", "each for itself"])
def test_a_program_that_stops_an_arm_also_stops_a_linked_arm_unless_the_first_arm_stood_still(linked: bool) -> None:
    driver = engaged(linked=linked)
    driver.teleop.pause(driver.now, Reason(TeleopReason.TOOL_UNKNOWN), "left")
    assert driver.states == (LOST if linked else {"left": "lost", "right": "engaged"})
    driver.run(0.1)
    if linked:
        driver.press("right")
        driver.teleop.pause(driver.now, Reason(TeleopReason.TOOL_UNKNOWN), "left")
        assert driver.states == {"left": "lost", "right": "engaged"}


def test_a_reset_arm_holds_until_a_press_after_a_new_sample_of_its_hand() -> None:
    driver = engaged(linked=False)
    driver.teleop.reset(driver.now, "left", Reason(TeleopReason.RESET_SERVICE))
    assert driver.states == {"left": "lost", "right": "engaged"}
    driver.teleop.take_events()
    driver.teleop.reset(driver.now, "left", Reason(TeleopReason.RESET_SERVICE))
    # The arm already holds, but the second reset is reported as well.
    assert [event.kind for event in driver.teleop.take_events()] == ["reset_service"]
    driver.silent = {"left"}
    driver.run(0.1)
    driver.press("left")
    assert driver.states["left"] == "lost"
    driver.silent = set()
    driver.run(0.1)
    driver.press("left")
    assert driver.states == ENGAGED


def test_silence_of_the_hands_stops_the_arms_within_the_timeout_and_one_tick() -> None:
    driver = engaged()
    driver.tick(driver.samples())
    driver.silent = set(SIDES)
    history = driver.run(0.3)
    following = sum(targets["left"].pose is not None for targets in history)
    assert 148 <= following <= 151


def test_a_reading_of_the_buttons_that_arrives_after_a_newer_reading_causes_no_press() -> None:
    driver = engaged()
    driver.tick(driver.samples())
    late = replace(sample("left", driver.hands["left"], driver.now, lower=True), inputs_stamp=driver.now - 0.005)
    driver.tick([late])
    driver.run(0.2)
    assert driver.states == ENGAGED


def test_a_lost_connection_pauses_every_arm_and_requires_new_poses_and_a_new_press() -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    driver.teleop.connection_lost(driver.now)
    assert driver.states == LOST
    assert {event.kind for event in driver.teleop.take_events()} == {"connection_lost"}
    driver.lower = set(SIDES)
    driver.assert_holds()
    driver.lower = set()
    driver.run(0.1)
    driver.press(*SIDES)
    assert driver.states == ENGAGED


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (lambda s: spoilt(s, pose_stamp=9.0), "pose_silent"),
        (lambda s: spoilt(s, pose_stamp=-math.inf), "pose_silent"),
        (lambda s: spoilt(s, quaternion=np.zeros(4)), "no_pose"),
    ],
    ids=["stale", "never received", "not usable"],
)
def test_engaging_is_refused_if_the_hand_has_no_usable_pose(
    alter: Callable[[HandSample], HandSample], reason: str
) -> None:
    driver = operator()
    driver.alter = alter
    driver.run(0.3)
    driver.press(*SIDES)
    assert driver.states == IDLE
    assert [kinds(event.reason) for event in driver.events] == [f"not_engaged: {reason}"] * 2


@pytest.mark.parametrize("tools", [{}, dict.fromkeys(SIDES, pose(math.nan))], ids=["missing", "not finite"])
def test_engaging_is_refused_if_the_tool_pose_is_missing_or_not_finite(tools: dict[str, pin.SE3]) -> None:
    driver = operator()
    driver.tools = tools
    driver.engage()
    assert driver.states == IDLE
    assert driver.refusals() == {"not_engaged: tool_unknown"}


def test_after_a_stall_of_the_loop_the_arms_stop_instead_of_catching_up() -> None:
    driver = engaged()
    driver.run(0.1, waving(driver))
    driver.hands = {hand: pose(1.0) for hand in SIDES}
    driver.now += 1.0
    assert driver.tick(driver.samples())["left"].pose is None
    driver.assert_holds()


@pytest.mark.parametrize("back", [0.001, 0.1], ids=["a millisecond", "a tenth of a second"])
def test_the_target_stays_if_the_clock_goes_back_by_up_to_a_tenth_of_a_second(back: float) -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    before = driver.targets
    after = driver.teleop.update(driver.samples(), driver.tools, driver.now - back)
    assert_smooth([before, after], 1e-12)
    assert driver.states == ENGAGED


@pytest.mark.parametrize("now", [math.nan, math.inf, -math.inf, -1e9, 0.0, 1e12], ids=str)
def test_an_unusable_time_stops_the_arms_and_a_later_press_engages_them(now: float) -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    targets = driver.teleop.update(driver.samples(), driver.tools, now)
    assert targets["left"].pose is targets["right"].pose is None
    if math.isfinite(now):
        driver.now = driver._next_sample = now
    driver.assert_holds()
    driver.press(*SIDES)
    assert driver.states == ENGAGED


values = st.one_of(st.floats(allow_nan=True), st.sampled_from([0.0, 1.0, math.nan, math.inf, 1e308]))
hostile = st.builds(
    lambda hand, position, quaternion, stamps, buttons: spoilt(
        sample("left", pose(), stamps[0], lower=buttons[0], upper=buttons[1]),
        hand=hand,
        position=np.array(position),
        quaternion=np.array(quaternion),
        inputs_stamp=stamps[1],
    ),
    st.sampled_from(["left", "right", "head"]),
    st.lists(values, min_size=3, max_size=3),
    st.lists(values, min_size=4, max_size=4),
    st.tuples(values, values),
    st.tuples(st.booleans(), st.booleans()),
)


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.lists(hostile, max_size=3), values), max_size=20), st.booleans())
def test_no_input_raises_an_error_and_every_target_is_finite(
    ticks: list[tuple[list[HandSample], float]], start_engaged: bool
) -> None:
    driver = engaged() if start_engaged else operator()
    for samples, now in ticks:
        targets = driver.teleop.update(samples, driver.tools, now)
        targets |= driver.tick([*driver.samples(), *samples])
        for target in targets.values():
            assert target.pose is None or np.isfinite(target.pose.homogeneous).all()
