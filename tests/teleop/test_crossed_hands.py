"""Swapped controllers cause a warning. Hands that cross during ordinary work cause no warning."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.teleop.crossed_hands import CrossedHands
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, HandSample
from tests.teleop.hands import ENGAGED, Operator, pose, sample

WORLD, UNITY = ("+x", "+y", "+z"), ("+z", "-x", "+y")
Places = Callable[[float], dict[str, pin.SE3]]


def after(places: Places, seconds: float = 5.0, axes: tuple[str, str, str] = WORLD, spoil: float = math.inf) -> bool:
    """Return whether hands with these poses count as crossed at the end.

    Args:
        places: Returns the poses of the hands at a time [s].
        seconds: Duration of the motion [s].
        axes: The setting ``teleop.axes``.
        spoil: Time at which a pose of the left hand is not usable [s].
    """
    hands = CrossedHands(axes)
    for t in np.arange(0.0, seconds, 0.0125):
        for hand in SIDES:
            one = sample(hand, places(t)[hand], float(t))
            hands.add(replace(one, position=np.full(3, np.nan)) if hand == "left" and abs(t - spoil) < 0.01 else one)
    return hands.crossed(seconds)


def swapped(by: float = 0.4, heading: float = 0.0, turns: float = 0.0) -> Places:
    """Return the poses of resting hands. The left hand is ``by`` [m] to the right of the right hand.

    The operator faces ``heading`` [rad]. Each controller is turned outwards by ``turns`` [rad].
    """
    left = np.array([math.sin(heading), -math.cos(heading), 0.0]) * by / 2.0
    room = pin.rpy.rpyToMatrix(0.0, 0.0, heading)
    made = {
        hand: pin.SE3(room @ pin.rpy.rpyToMatrix(0.1, -0.3, sign * turns), sign * left + np.array([0.3, 0.1, 1.0]))
        for hand, sign in (("left", 1.0), ("right", -1.0))
    }
    return lambda t: made


@pytest.mark.parametrize("heading", [0.0, 1.5, math.pi, -2.0])
def test_swapped_controllers_are_noticed_for_every_direction_that_the_operator_faces(heading: float) -> None:
    assert after(swapped(heading=heading))
    assert not after(swapped(by=-0.4, heading=heading))


def test_crossed_hands_are_detected_in_other_axes_of_the_input_too() -> None:
    made = {hand: pose(*place) for hand, place in (("left", (0.2, 1.0, 0.3)), ("right", (-0.2, 1.0, 0.3)))}
    assert after(lambda t: made, axes=UNITY), "right is +x in the frame of Unity"
    assert not after(lambda t: {"left": made["right"], "right": made["left"]}, axes=UNITY)


@pytest.mark.parametrize(
    "places",
    [
        swapped(by=0.08),
        swapped(turns=1.3),
        lambda t: swapped(by=0.4 * math.cos(t))(t),
        lambda t: swapped(by=0.4 if t > 2.5 else -0.4)(t),
    ],
    ids=["less than 10 cm", "controllers turned apart", "to and fro", "for 2.5 s only"],
)
def test_hands_that_cross_in_ordinary_work_do_not_count_as_crossed(places: Places) -> None:
    assert not after(places)


def test_hands_count_as_crossed_only_if_both_were_tracked_for_the_whole_time() -> None:
    assert not after(swapped(), spoil=3.0)
    assert after(swapped(), spoil=1.0)


def test_hands_never_count_as_crossed_if_one_hand_is_missing_or_if_their_poses_are_old() -> None:
    hands = CrossedHands(WORLD)
    for t in np.arange(0.0, 5.0, 0.0125):
        hands.add(sample("left", swapped()(t)["left"], float(t)))
    assert not hands.crossed(5.0)
    for t in np.arange(5.0, 10.0, 0.0125):
        for hand in SIDES:
            hands.add(sample(hand, swapped()(t)[hand], float(t)))
    assert hands.crossed(10.0)
    assert not hands.crossed(11.0)


def crossed_operator(spoil: Callable[[HandSample], HandSample] = lambda one: one) -> Operator:
    driver = Operator(alter=spoil)
    driver.hands = {"left": pose(0.3, -0.2, 1.0), "right": pose(0.3, 0.2, 1.0)}
    return driver


def test_engaging_with_swapped_controllers_records_one_warning_and_the_arms_still_follow() -> None:
    driver = crossed_operator()
    driver.run(3.5)
    driver.press(*SIDES)
    assert driver.states == ENGAGED
    said = [event for event in driver.events if event.kind is TeleopReason.HANDS_CROSSED]
    assert len(said) == 1
    assert said[0].source == said[0].destination
    driver.run(1.0)
    assert driver.states == ENGAGED


def test_engaging_records_no_warning_if_the_controllers_are_not_swapped() -> None:
    driver = Operator()
    driver.run(3.5)
    driver.press(*SIDES)
    assert driver.states == ENGAGED
    assert TeleopReason.HANDS_CROSSED not in {event.kind for event in driver.events}
