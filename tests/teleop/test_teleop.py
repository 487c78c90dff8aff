"""The teleop layer as a whole: engaging, pausing, faults, chords. Targets are checked at every tick."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.teleop.settings import TeleopSettings
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES, ArmTarget, Array, HandSample
from tests.teleop.hands import TICK, Operator, pose, sample, spoilt

History = list[dict[str, ArmTarget]]
PAUSED = {"left": "paused", "right": "paused"}
ENGAGED = {"left": "engaged", "right": "engaged"}


def operator(**changes: object) -> Operator:
    return Operator(TeleopSettings.model_validate(changes))


def engaged(**changes: object) -> Operator:
    driver = operator(**changes)
    driver.engage()
    assert driver.states == ENGAGED
    return driver


def waving(driver: Operator, speed: float = 0.2) -> Callable[[float], dict[str, pin.SE3]]:
    """Both hands going sidewards and turning from where they are."""
    start = dict(driver.hands)
    return lambda t: {
        hand: pin.SE3(pin.exp3(np.array([0.0, 0.0, speed * t])) @ at.rotation, at.translation + sidewards(speed * t))
        for hand, at in start.items()
    }


def sidewards(way: float) -> Array:
    return np.array([0.0, way, 0.0])


def first_targets(history: History, arm: str) -> pin.SE3:
    return next(targets[arm].pose for targets in history if targets[arm].pose is not None)


def assert_smooth(history: History, largest: float = 0.002) -> None:
    """Between two ticks of one engagement a target moves by less than ``largest`` metres and 3 ``largest`` radians."""
    for before, after in pairwise(history):
        for arm in SIDES:
            a, b = before[arm].pose, after[arm].pose
            if a is not None and b is not None:
                assert np.linalg.norm(b.translation - a.translation) < largest
                assert np.linalg.norm(pin.log3(a.rotation.T @ b.rotation)) < 3 * largest


def assert_holds(driver: Operator, duration: float = 0.4) -> None:
    """Both arms hold at every tick, although the hands go on waving."""
    for targets in driver.run(duration, waving(driver)):
        assert targets["left"].pose is None
        assert targets["right"].pose is None


def test_it_starts_paused_and_the_first_press_of_the_lower_button_engages_that_arm_alone() -> None:
    driver = operator()
    assert_holds(driver)
    driver.engage("left")
    assert driver.states == {"left": "engaged", "right": "paused"}
    assert driver.teleop.engaged == {"left": True, "right": False}
    assert [(e.arm, e.source, e.destination, e.reason) for e in driver.events] == [
        ("left", "paused", "engaged", "lower button")
    ]


@settings(derandomize=True, max_examples=25, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12), st.sampled_from([1.0, -1.0]))
def test_the_first_target_is_the_measured_tool_pose_whatever_the_hand(n: list[float], sign: float) -> None:
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
def test_the_right_arm_goes_as_the_stance_says(stance: str, right_goes: tuple[float, float, float]) -> None:
    driver = engaged(stance=stance)
    hands, ways = driver.hands, {"left": np.array([-0.3, 0.1, 0.1]), "right": np.array([0.1, 0.2, 0.3])}
    history = driver.run(
        2.0, lambda t: {hand: pose(*(hands[hand].translation + ways[hand] * min(t, 1.0))) for hand in SIDES}
    )
    way = first_targets(history[::-1], "right").translation - driver.tools["right"].translation
    np.testing.assert_allclose(way, np.array(right_goes), atol=1e-4)
    assert driver.teleop.hand_of("right") == ("right" if stance == "side_by_side" else "left")


def test_pausing_stops_at_the_first_reading_of_the_button() -> None:
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


def test_resuming_anchors_hand_and_tool_anew_and_carries_the_orientation_on() -> None:
    driver = engaged()
    history = driver.run(0.5, waving(driver))
    driver.lower = set(SIDES)
    history += driver.run(0.15)
    carried = {arm: first_targets(history[::-1], arm).rotation for arm in SIDES}
    driver.lower = set()
    driver.hands = {hand: pose(1.0, -2.0, 0.5, (2.0, 0.3, 0.1)) for hand in SIDES}
    driver.run(0.1)
    driver.tools = {"left": pose(0.6, 0.3, 0.5, (3.1, 0.0, 0.1)), "right": pose(0.4, -0.3, 0.5, (0.0, 3.0, 0.0))}
    driver.lower = set(SIDES)
    history = driver.run(0.2)
    for arm in SIDES:
        first = first_targets(history, arm)
        np.testing.assert_allclose(first.translation, driver.tools[arm].translation, atol=1e-9)
        np.testing.assert_allclose(first.rotation, carried[arm], atol=1e-9)


def test_the_orientation_carried_on_is_the_controllers_where_it_is_given() -> None:
    driver = engaged()
    driver.run(0.5, waving(driver))
    driver.press(*SIDES)
    driver.commanded = {arm: pose(9.0, 9.0, 9.0, (0.1, 0.2, 0.3)) for arm in SIDES}
    driver.lower = set(SIDES)
    first = first_targets(driver.run(0.2), "left")
    np.testing.assert_allclose(first.translation, driver.tools["left"].translation, atol=1e-9)
    np.testing.assert_allclose(first.rotation, driver.commanded["left"].rotation, atol=1e-9)


def test_a_thousand_pauses_with_the_hand_turning_in_between_do_not_drift() -> None:
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


FAULTS: dict[str, Callable[[HandSample], HandSample]] = {
    "pose for 0.15 s": lambda s: spoilt(s, pose_stamp=10.29),
    "button data for 0.15 s": lambda s: spoilt(s, inputs_stamp=10.29),
    "not finite or not a rotation": lambda s: spoilt(s, position=np.array([np.nan, 0.0, 0.0])),
    "not a rotation": lambda s: spoilt(s, quaternion=np.zeros(4)),
    "jumped 1": lambda s: spoilt(s, position=s.position + 1.0),
    "rotation jumped": lambda s: spoilt(s, quaternion=np.array([1.0, 0.0, 0.0, 0.0])),
    "without a receipt time": lambda s: spoilt(s, pose_stamp=math.nan),
}


@pytest.mark.parametrize("linked", [True, False], ids=["linked", "each for itself"])
@pytest.mark.parametrize("reason", list(FAULTS))
def test_a_fault_of_the_left_hand_disengages(reason: str, linked: bool) -> None:
    driver = engaged(linked=linked)
    driver.alter = lambda s: FAULTS[reason](s) if s.hand == "left" else s
    history = driver.run(0.3, waving(driver))
    assert_smooth(history)
    assert driver.states == (PAUSED if linked else {"left": "paused", "right": "engaged"})
    last = [event for event in driver.events if event.destination == "paused"]
    assert reason in last[0].reason
    assert [event.arm for event in last] == (["left", "right"] if linked else ["left"])
    driver.alter = lambda s: s
    if linked:
        assert_holds(driver)
    driver.press("left")
    assert driver.states["left"] == "engaged"


def test_silence_disengages_within_the_timeout_and_a_tick() -> None:
    driver = engaged()
    driver.tick(driver.samples())
    driver.silent = set(SIDES)
    history = driver.run(0.3)
    following = sum(targets["left"].pose is not None for targets in history)
    assert 148 <= following <= 151


def test_after_silence_the_hand_may_come_back_anywhere_and_the_arm_stays() -> None:
    driver = engaged()
    driver.silent = {"left"}
    driver.run(0.3)
    driver.hands["left"] = pose(2.0, 2.0, 2.0, (1.0, 1.0, 1.0))
    driver.silent = set()
    assert_holds(driver)
    driver.lower = {"left"}
    first = first_targets(driver.run(0.2), "left")
    np.testing.assert_allclose(first.translation, driver.tools["left"].translation, atol=1e-9)


def test_a_button_held_through_a_fault_does_not_engage_again_until_released_and_pressed() -> None:
    driver = operator()
    driver.run(0.1)
    driver.lower = set(SIDES)
    driver.run(0.3)
    assert driver.states == ENGAGED
    driver.silent = set(SIDES)
    driver.run(0.3)
    driver.silent = set()
    assert_holds(driver)
    driver.lower = set()
    assert_holds(driver)
    driver.press(*SIDES)
    assert driver.states == ENGAGED


def test_a_press_that_a_fault_interrupts_does_not_engage() -> None:
    driver = engaged()
    driver.press("left")
    driver.lower = {"left"}
    driver.run(0.03)
    driver.alter = lambda s: spoilt(s, quaternion=np.zeros(4)) if s.hand == "right" else s
    driver.run(0.03)
    driver.alter = lambda s: s
    assert_holds(driver)


def test_a_lost_connection_pauses_every_arm_and_wants_fresh_poses_and_a_new_press() -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    driver.teleop.connection_lost(driver.now)
    assert driver.states == PAUSED
    assert {event.reason for event in driver.teleop.take_events()} == {"connection lost"}
    driver.lower = set(SIDES)
    assert_holds(driver)
    driver.lower = set()
    driver.run(0.1)
    driver.press(*SIDES)
    assert driver.states == ENGAGED


@pytest.mark.parametrize(
    ("alter", "reason"),
    [
        (lambda s: spoilt(s, pose_stamp=9.0), "no pose for 0.15 s"),
        (lambda s: spoilt(s, pose_stamp=-math.inf), "no pose for 0.15 s"),
        (lambda s: spoilt(s, quaternion=np.zeros(4)), "the newest pose is not usable"),
    ],
    ids=["stale", "never received", "not usable"],
)
def test_engaging_is_refused_when_poses_are(alter: Callable[[HandSample], HandSample], reason: str) -> None:
    driver = operator()
    driver.alter = alter
    driver.run(0.3)
    driver.press(*SIDES)
    assert driver.states == PAUSED
    assert [event.reason for event in driver.events] == [f"not engaged: {reason}"] * 2


@pytest.mark.parametrize("tools", [{}, dict.fromkeys(SIDES, pose(math.nan))], ids=["missing", "not finite"])
def test_engaging_is_refused_when_the_tools_pose_is(tools: dict[str, pin.SE3]) -> None:
    driver = operator()
    driver.tools = tools
    driver.engage()
    assert driver.states == PAUSED
    assert {event.reason for event in driver.events} == {"not engaged: the tool's pose is not known"}


def test_the_upper_button_toggles_its_own_gripper_once_a_press() -> None:
    driver = engaged()
    openings = []
    for _ in range(4):
        driver.press("left", button="upper")
        openings.append((driver.targets["left"].gripper, driver.targets["right"].gripper))
    assert openings == [(0.0, 1.0), (1.0, 1.0), (0.0, 1.0), (1.0, 1.0)]
    assert driver.states == ENGAGED


@pytest.mark.parametrize("first", ["lower", "upper"])
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.06], ids="{} s apart".format)
def test_a_chord_moves_no_gripper_stops_both_arms_and_anchors_anew_when_released(first: str, delay: float) -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    (driver.lower if first == "lower" else driver.upper).add("left")
    driver.run(delay)
    driver.lower, driver.upper = {"left"}, {"left"}
    driver.tick(driver.samples())
    assert driver.states == {"left": "aligning", "right": "aligning"}
    assert_holds(driver)
    driver.hands = {hand: pose(-1.0, 0.5, 0.2, (0.5, 1.5, 0.0)) for hand in SIDES}
    driver.run(0.1)
    driver.tools = {"left": pose(0.6, 0.3, 0.5), "right": pose(0.4, -0.3, 0.5)}
    driver.lower, driver.upper = set(), {"left"}
    assert_holds(driver, 0.1)
    driver.upper = set()
    history = driver.run(0.3)
    assert driver.states == ENGAGED
    for arm in SIDES:
        assert history[-1][arm].gripper == 1.0
        np.testing.assert_allclose(first_targets(history, arm).translation, driver.tools[arm].translation, atol=1e-9)
    assert_smooth(history)


def test_a_chord_on_paused_arms_engages_nothing() -> None:
    driver = operator()
    driver.run(0.1)
    driver.lower = driver.upper = {"right"}
    assert_holds(driver)
    driver.lower = driver.upper = set()
    assert_holds(driver)
    assert driver.events == []


def test_silence_during_a_chord_disengages_for_good() -> None:
    driver = engaged()
    driver.lower = driver.upper = {"left"}
    driver.run(0.1)
    driver.silent = {"left"}
    driver.run(0.3)
    driver.silent, driver.lower, driver.upper = set(), set(), set()
    assert_holds(driver)


def test_a_stalled_loop_disengages_instead_of_catching_up() -> None:
    driver = engaged()
    driver.run(0.1, waving(driver))
    driver.hands = {hand: pose(*(at.translation + sidewards(0.1))) for hand, at in driver.hands.items()}
    driver.now += 1.0
    assert driver.tick(driver.samples())["left"].pose is None
    assert_holds(driver)


@pytest.mark.parametrize("back", [0.001, 0.1], ids=["a millisecond", "a tenth of a second"])
def test_a_clock_that_goes_back_a_little_holds_the_target_still(back: float) -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    before = driver.targets
    after = driver.teleop.update(driver.samples(), driver.tools, driver.now - back)
    assert_smooth([before, after], 1e-12)
    assert driver.states == ENGAGED


@pytest.mark.parametrize("now", [math.nan, math.inf, -math.inf, -1e9, 0.0, 1e12], ids=str)
def test_a_clock_that_cannot_be_followed_disengages_and_a_press_on_the_new_one_engages(now: float) -> None:
    driver = engaged()
    driver.run(0.2, waving(driver))
    targets = driver.teleop.update(driver.samples(), driver.tools, now)
    assert targets["left"].pose is targets["right"].pose is None
    if math.isfinite(now):
        driver.now = driver._next_sample = now
    assert_holds(driver)
    driver.press(*SIDES)
    assert driver.states == ENGAGED


def test_bursts_doubled_overtaken_and_unknown_samples_make_no_jump() -> None:
    driver = engaged()
    history = [driver.targets]
    hand = driver.hands["left"].translation
    for burst in range(20):
        samples = [
            sample("left", pose(*(hand + sidewards(0.002 * (burst + k / 50)))), driver.now - 0.0002 * (50 - k))
            for k in range(50)
        ]
        samples += [samples[-1], samples[3], samples[-1]]
        samples += [replace(samples[0], hand=name) for name in ("middle", "")]
        history.append(driver.tick([*samples, sample("right", driver.hands["right"], driver.now)]))
        history += driver.run(0.02, lambda t: {}) if burst % 3 == 0 else [driver.tick([]) for _ in range(20)]
        driver.silent = {"left"}
    assert driver.states == ENGAGED
    assert_smooth(history)


def test_one_arm_may_be_driven_alone() -> None:
    driver = Operator(arms=("right",))
    driver.engage()
    assert driver.states == {"right": "engaged"}
    assert set(driver.targets) == {"right"}


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
def test_no_input_raises_and_every_target_is_finite(
    ticks: list[tuple[list[HandSample], float]], start_engaged: bool
) -> None:
    driver = engaged() if start_engaged else operator()
    for samples, now in ticks:
        targets = driver.teleop.update(samples, driver.tools, now)
        targets |= driver.tick([*driver.samples(), *samples])
        for target in targets.values():
            assert target.pose is None or np.isfinite(target.pose.homogeneous).all()


def test_the_delay_is_stated() -> None:
    assert Teleop(TeleopSettings(), SIDES).delay == pytest.approx(0.045)
    assert TICK < Teleop(TeleopSettings(), SIDES).delay < 0.05
