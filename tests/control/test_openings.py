"""Fingers count at the openings that they may have: less is free, more is proven first, and nothing else moves."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.errors import RobotError
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import ALL_OF_THE_WAY, Array
from tests.support.coal_distances import coal_distances
from tests.support.driven import Driven
from tests.support.object_cell import ABOVE, BESIDE, CELL, SETTINGS, tips_at

DT = 0.002


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(CELL)


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, SETTINGS)


def closest_by_coal(controller: CartesianController, q: Array) -> float:
    robot = controller.robot
    model = collision_model_at(robot.collision_model, robot.finger_bodies, controller.openings)
    return float(coal_distances(robot, model, q).min())


def height(controller: CartesianController) -> float:
    return float(controller.tool_pose("left").translation[2])


def test_a_closed_gripper_gets_beside_a_block_where_one_that_may_open_does_not(controller: CartesianController) -> None:
    run = Driven(controller)
    run.drive(2.0, {"left": BESIDE})
    assert height(controller) > BESIDE.translation[2] + 0.01
    run = Driven(controller)
    assert run.set_opening("left", 0.0, 0.0) is None
    run.drive(2.0, {"left": BESIDE})
    assert height(controller) == pytest.approx(BESIDE.translation[2], abs=5e-4)


def test_beside_the_block_it_may_open_as_far_as_the_block_allows_and_above_it_at_will(
    controller: CartesianController,
) -> None:
    run = Driven(controller)
    run.set_opening("left", 0.0, 0.0)
    run.drive(2.0, {"left": BESIDE})
    for opening in (1.0, 0.6):
        pair = run.set_opening("left", 0.0, opening)
        assert pair is not None
        assert "block_0" in pair
        assert any("left_hand_e_finger" in name for name in pair)
        assert controller.openings["left"] == (0.0, 0.0)
    assert run.set_opening("left", 0.0, 0.4) is None
    reference = run.drive(0.1, {"left": BESIDE})
    assert reference.report.closest_distance == pytest.approx(closest_by_coal(controller, reference.q), abs=2e-6)
    run.drive(1.5, {"left": ABOVE})
    assert run.set_opening("left", *ALL_OF_THE_WAY) is None
    run.drive(0.1, {"left": ABOVE})


def test_an_opening_that_is_refused_leaves_every_bit_of_the_motion_as_it_was(robot: Robot) -> None:
    twins = [CartesianController(robot, SETTINGS) for _ in range(2)]
    for controller in twins:
        assert controller.set_opening("left", 0.0, 0.0) is None
    refused = 0
    for _ in range(700):
        if (twins[1].set_opening("left", 0.0, 1.0)) is not None:
            refused += 1
        else:
            # Where all of the way is accepted, both are told.
            twins[0].set_opening("left", 0.0, 1.0)
            assert [controller.set_opening("left", 0.0, 0.0) for controller in twins] == [None, None]
        first, second = (controller.step({"left": BESIDE}, DT) for controller in twins)
        np.testing.assert_array_equal(first.q, second.q)
        np.testing.assert_array_equal(first.v, second.v)
    assert refused > 100


def test_an_arm_at_speed_may_not_open_where_there_is_room_but_none_to_stop(controller: CartesianController) -> None:
    """Towards the block with the gripper closed, asked at every tick; Coal looks at stops from what is accepted."""
    robot = controller.robot
    kept = kept_distances(robot, SETTINGS).values
    run = Driven(controller)
    run.set_opening("left", 0.0, 0.0)
    run.drive(1.2, {"left": BESIDE})
    run = Driven(controller, run.drive(1.2, {"left": tips_at(0.05, 0.006)}).q)
    run.set_opening("left", 0.0, 0.0)
    answers = []
    for _ in range(150):
        reference = run.drive(DT, {"left": tips_at(0.4, 0.006)})
        q, v = reference.q, reference.v
        room = bool((robot.distance_values(q) >= kept).all())
        accepted = run.set_opening("left", *ALL_OF_THE_WAY) is None
        answers.append((room, accepted))
        stop = controller.stop_deceleration
        for time in np.linspace(0.0, float((np.abs(v) / stop).max()), 20) if accepted else ():
            moving = np.minimum(time, np.abs(v) / stop)
            braked = q + v * moving - 0.5 * np.sign(v) * stop * moving**2
            assert (robot.distance_values(braked) >= kept - 2e-6).all()
        run.set_opening("left", 0.0, 0.0)
    assert answers.count((True, True)) > 10
    assert answers.count((True, False)) > 3
    assert answers.count((False, False)) > 3
    assert (False, True) not in answers


def test_a_reset_forgets_openings(controller: CartesianController) -> None:
    controller.reset(controller.robot.home)
    controller.set_opening("left", 0.2, 0.3)
    assert controller.openings == {"left": (0.2, 0.3), "right": ALL_OF_THE_WAY}
    controller.reset(controller.robot.home)
    assert controller.openings == dict.fromkeys(("left", "right"), ALL_OF_THE_WAY)
    reference = controller.step({}, DT)
    assert reference.report.closest_distance == pytest.approx(closest_by_coal(controller, reference.q), abs=2e-6)


def test_measured_openings_a_little_beyond_the_ends_are_the_ends(controller: CartesianController) -> None:
    controller.reset(controller.robot.home)
    assert controller.set_opening("left", -0.03, 1.02) is None
    assert controller.openings["left"] == ALL_OF_THE_WAY


@pytest.mark.parametrize(
    ("arm", "least", "greatest", "complaint"),
    [
        ("middle", 0.0, 1.0, "no such arm; arms: left, right"),
        ("left", 0.6, 0.5, "the least first"),
        ("left", float("nan"), 1.0, "finite numbers"),
        ("left", 0.0, float("inf"), "finite numbers"),
        ("left", None, 1.0, "finite numbers"),
    ],
)
def test_what_is_no_opening_is_refused_by_name(
    controller: CartesianController, arm: str, least: float, greatest: float, complaint: str
) -> None:
    controller.reset(controller.robot.home)
    with pytest.raises(RobotError, match=complaint):
        controller.set_opening(arm, least, greatest)
    assert controller.openings["left"] == ALL_OF_THE_WAY


@pytest.mark.parametrize("below", [0.0, 1e-13, 5e-10])
def test_fingers_at_their_distance_to_the_last_digits_part_again(robot: Robot, below: float) -> None:
    run = Driven(CartesianController(robot, SETTINGS))
    run.set_opening("left", 0.0, 0.0)
    report = run.drive(2.0, {"left": BESIDE}).report
    assert "finger" in report.closest_pair[0] + report.closest_pair[1]
    kept = SETTINGS.distances.model_copy(update={"finger_obstacle": report.closest_distance + below})
    near = Driven(CartesianController(robot, SETTINGS.model_copy(update={"distances": kept})), run.q)
    near.set_opening("left", 0.0, 0.0)
    reference = near.drive(2.0, {"left": ABOVE})
    assert not reference.report.fallback
    assert np.linalg.norm(near.controller.tool_pose("left").translation - ABOVE.translation) < 1e-3
