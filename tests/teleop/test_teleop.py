"""The whole teleop layer engages arms, pauses arms, moves grippers and obeys chords. No target may jump at any tick."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES
from tests.teleop.hands import ENGAGED, assert_smooth, engaged, first_target, operator, pose, sample, spoilt, waving


def test_all_arms_start_idle_and_a_press_of_a_hands_lower_button_engages_only_the_arm_of_this_hand() -> None:
    driver = operator()
    driver.assert_holds()
    driver.engage("left")
    assert driver.states == {"left": "engaged", "right": "idle"}
    assert driver.teleop.engaged == {"left": True, "right": False}
    assert [(e.arm, e.source, e.destination, e.kind) for e in driver.events] == [("left", "idle", "engaged", "pressed")]


def test_a_target_contains_the_filtered_hand_pose_which_is_none_while_the_arm_holds() -> None:
    driver = engaged()
    driver.run(0.3, waving(driver))
    driver.run(1.5)
    for arm in SIDES:
        hand = driver.targets[arm].hand
        assert hand is not None
        np.testing.assert_allclose(hand.homogeneous, driver.hands[arm].homogeneous, atol=1e-4)
    driver.press(*SIDES)
    assert all(target.hand is None for target in driver.targets.values())


@settings(derandomize=True, max_examples=25, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12), st.sampled_from([1.0, -1.0]))
def test_the_first_target_is_the_measured_tool_pose_for_any_hand_pose(n: list[float], sign: float) -> None:
    teleop = Teleop(TeleopSettings(), ("left",))
    hand, tool = pose(n[0], n[1], n[2], (n[3], n[4], n[5])), pose(n[6], n[7], n[8], (n[9], n[10], n[11]))
    for stamp, lower in ((1.0, False), (1.01, True), (1.02, False)):
        target = teleop.update([sample("left", hand, stamp, lower=lower, sign=sign)], {"left": tool}, stamp)["left"]
    assert target.pose is not None
    np.testing.assert_allclose(target.pose.homogeneous, tool.homogeneous, atol=1e-9)


@pytest.mark.parametrize(
    ("stance", "right_goes"),
    [("side_by_side", (0.1, 0.2, 0.3)), ("mirror", (-0.3, 0.1, 0.1)), ("mirror_reflected", (-0.3, -0.1, 0.1))],
)
def test_the_right_arm_moves_as_the_stance_says(stance: str, right_goes: tuple[float, float, float]) -> None:
    driver = engaged(stance=stance)
    hands, ways = driver.hands, {"left": np.array([-0.3, 0.1, 0.1]), "right": np.array([0.1, 0.2, 0.3])}
    history = driver.run(
        2.0, lambda t: {hand: pose(*(hands[hand].translation + ways[hand] * min(t, 1.0))) for hand in SIDES}
    )
    way = first_target(history[::-1], "right").translation - driver.tools["right"].translation
    np.testing.assert_allclose(way, np.array(right_goes), atol=1e-4)
    assert driver.teleop.hand_of("right") == ("right" if stance == "side_by_side" else "left")


def test_an_arm_stops_at_the_first_reading_of_the_button_that_pauses_it() -> None:
    driver = engaged()
    driver.run(0.3, waving(driver))
    driver.lower = {"left"}
    targets = driver.tick(driver.samples())
    assert targets["left"].pose is None
    assert targets["right"].pose is not None
    driver.run(0.2)
    driver.lower = set()
    driver.run(0.2)
    assert driver.states == {"left": "paused", "right": "engaged"}


def test_the_first_target_after_a_pause_has_the_measured_position_and_the_last_targets_orientation() -> None:
    driver = engaged()
    history = driver.run(0.5, waving(driver))
    driver.lower = set(SIDES)
    history += driver.run(0.15)
    carried = {arm: first_target(history[::-1], arm).rotation for arm in SIDES}
    driver.lower = set()
    driver.hands = {hand: pose(1.0, -2.0, 0.5, (2.0, 0.3, 0.1)) for hand in SIDES}
    driver.run(0.1)
    driver.tools = {"left": pose(0.6, 0.3, 0.5, (3.1, 0.0, 0.1)), "right": pose(0.4, -0.3, 0.5, (0.0, 3.0, 0.0))}
    driver.lower = set(SIDES)
    history = driver.run(0.2)
    for arm in SIDES:
        first = first_target(history, arm)
        np.testing.assert_allclose(first.translation, driver.tools[arm].translation, atol=1e-9)
        np.testing.assert_allclose(first.rotation, carried[arm], atol=1e-9)


def test_the_target_still_begins_at_the_tool_after_a_thousand_pauses_in_which_the_hand_moves() -> None:
    teleop, tool, now = Teleop(TeleopSettings(), ("left",)), pose(0.5, 0.1, 0.4, (3.0, 0.2, 0.1)), 0.0
    random, hand, firsts = np.random.default_rng(0), pose(), []
    for press in range(2001):
        for lower in (False, True, False):
            now += 0.014
            target = teleop.update([sample("left", hand, now, lower=lower)], {"left": tool}, now)["left"].pose
        if press % 2 == 0:
            assert target is not None
            firsts.append(target.homogeneous)
        else:
            assert target is None
            hand = pin.SE3(pin.exp3(random.uniform(-3, 3, 3)), random.uniform(-1, 1, 3))
    assert len(firsts) == 1001
    np.testing.assert_allclose(firsts, np.broadcast_to(tool.homogeneous, (1001, 4, 4)), atol=1e-9)


def test_each_press_of_a_hands_upper_button_toggles_the_gripper_of_its_arm() -> None:
    driver = engaged()
    openings = []
    for _ in range(4):
        driver.press("left", button="upper")
        openings.append((driver.targets["left"].gripper, driver.targets["right"].gripper))
    assert openings == [(0.0, 1.0), (1.0, 1.0), (0.0, 1.0), (1.0, 1.0)]
    assert driver.states == ENGAGED


@pytest.mark.parametrize(("first", "delay"), [("lower", 0.0), ("lower", 0.06), ("upper", 0.03)])
def test_a_chord_stops_both_arms_and_its_release_sets_new_anchors_while_no_gripper_moves(
    first: str, delay: float
) -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    (driver.lower if first == "lower" else driver.upper).add("left")
    driver.run(delay)
    driver.lower, driver.upper = {"left"}, {"left"}
    driver.tick(driver.samples())
    assert driver.states == {"left": "aligning", "right": "aligning"}
    driver.assert_holds()
    driver.hands = {hand: pose(-1.0, 0.5, 0.2, (0.5, 1.5, 0.0)) for hand in SIDES}
    driver.run(0.1)
    driver.tools = {"left": pose(0.6, 0.3, 0.5), "right": pose(0.4, -0.3, 0.5)}
    driver.lower, driver.upper = set(), {"left"}
    driver.assert_holds(0.1)
    driver.upper = set()
    history = driver.run(0.3)
    assert driver.states == ENGAGED
    for arm in SIDES:
        assert history[-1][arm].gripper == 1.0
        np.testing.assert_allclose(first_target(history, arm).translation, driver.tools[arm].translation, atol=1e-9)
    assert_smooth(history)


def test_an_alignment_ends_only_when_a_pose_comes_after_the_buttons_were_released() -> None:
    driver = engaged()
    driver.lower, driver.upper = set(SIDES), set(SIDES)
    driver.run(0.05)
    assert driver.states == {"left": "aligning", "right": "aligning"}
    before = driver.now - 0.02
    driver.alter = lambda received: spoilt(received, pose_stamp=before)
    driver.lower, driver.upper = set(), set()
    driver.tick(driver.samples())
    assert driver.states == {"left": "aligning", "right": "aligning"}
    driver.alter = lambda received: received
    driver.tick(driver.samples())
    assert driver.states == ENGAGED


DT = 0.002


def tracking_error(script: ScriptedInput, duration: float) -> tuple[float, float]:
    """Return the RMS distance [mm] and the RMS angle [deg] between the left target and its ideal pose.

    The ideal pose repeats the hand's motion with the delay of the filter. All ticks with an engaged arm count.
    """
    teleop = Teleop(TeleopSettings(), SIDES)
    tools = {"left": pose(0.5, 0.4, 0.5, (3.0, 0.1, 0.2)), "right": pose(0.5, -0.4, 0.5)}
    script.start()
    distances, angles = [], []
    start = script.hand_pose("left", 0.0)
    for tick in range(round(duration / DT)):
        now = tick * DT
        target = teleop.update(script.poll(now), tools, now)["left"].pose
        if target is not None:
            hand = script.hand_pose("left", now - teleop.delay)
            ideal = tools["left"].translation + hand.translation - start.translation
            distances.append(np.linalg.norm(target.translation - ideal))
            turn = hand.rotation @ start.rotation.T @ tools["left"].rotation
            angles.append(np.linalg.norm(pin.log3(turn.T @ target.rotation)))
    assert len(distances) * DT > duration - 1.5
    return 1e3 * math.sqrt(np.mean(np.square(distances))), math.degrees(math.sqrt(np.mean(np.square(angles))))


@pytest.mark.parametrize("trajectory", ["circle", "rotate"])
def test_the_target_follows_the_hand_within_a_millimetre_and_a_third_of_a_degree(trajectory: str) -> None:
    distance, angle = tracking_error(ScriptedInput(trajectory, frequency_hz=0.5), 6.0)
    assert distance < 1.0
    assert angle < 0.33
