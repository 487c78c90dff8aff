"""Obstacles that move on their own. Arms come to rest before an obstacle can touch them, and can work beside it.

In this file, a hand is such an obstacle, for example the hand of a person beside the arms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.kernel_model import kernel_model_of
from q2r2_control.errors import ConfigError
from q2r2_control.types import StepStatus
from tests.control.hunted_arms import (
    RADIUS,
    Coal,
    Hunt,
    controller_and_solver,
    controller_at_home,
    hand,
    robot_of_cell,
)


@pytest.fixture
def controller() -> Iterator[CartesianController]:
    made = controller_at_home()
    yield made
    made.move_obstacle("hand", None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "period", "acceleration", "box"),
    [
        pytest.param(0.25, 0.033, None, False, id="a slow hand, reported often"),
        pytest.param(1.6, 0.033, None, False, id="a person who walks"),
        pytest.param(0.5, 0.3, None, True, id="a box that is reported too seldom"),
        pytest.param(1.0, 0.033, 3.0, False, id="with a bound on its acceleration"),
    ],
)
def test_no_moving_body_comes_too_close_to_a_hand_that_chases_it(
    controller: CartesianController, speed: float, period: float, acceleration: float | None, box: bool
) -> None:
    hunt = Hunt(controller, controller_and_solver()[1], seed=1, box=box)
    hunt.run(6.0, speed, period, acceleration)
    assert not hunt.broken
    assert hunt.touched > 50, "it gets to arms that rest"
    assert hunt.moved > 500, "and arms move whenever they may"


@pytest.mark.slow
def test_a_hand_that_is_faster_than_reported_can_come_too_close_to_a_moving_arm(
    controller: CartesianController,
) -> None:
    hunt = Hunt(controller, controller_and_solver()[1], seed=1, lie=5.0)
    hunt.run(6.0, 0.25, 0.1)
    assert hunt.broken, "or the test above could not fail"


def circle(t: float, start: dict[str, pin.SE3], radius: float = 0.05, turns: float = 0.8) -> dict[str, pin.SE3]:
    angle = 2.0 * np.pi * turns * t
    by = radius * np.array([np.sin(angle), 0.0, 1.0 - np.cos(angle)])
    return {arm: pin.SE3(pose.rotation, pose.translation + by) for arm, pose in start.items()}


def worst_error(controller: CartesianController, obstacle: MovingObstacle | None, seconds: float = 3.0) -> float:
    """Return the greatest position error of the left tool after the first second [m]. Both targets move in circles."""
    start, worst = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}, 0.0
    for tick in range(round(seconds / 0.002)):
        if obstacle is not None and tick % 16 == 0:
            controller.move_obstacle("hand", obstacle)
        targets = circle(0.002 * tick, start)
        report = controller.step(targets, 0.002).report
        if tick > 500:
            away = controller.tool_pose("left").translation - targets["left"].translation
            worst = max(worst, float(np.linalg.norm(away)))
            assert report.status is StepStatus.OK
            assert report.certified
            assert not report.fallback
    return worst


def test_arms_beside_a_slow_hand_follow_nearly_as_accurately_as_without_a_hand(controller: CartesianController) -> None:
    free = worst_error(controller, None)
    controller.reset(controller.robot.home)
    side = controller.tool_pose("left").translation + np.array([0.0, 0.3 + RADIUS + 0.06, 0.0])
    beside = worst_error(controller, hand(side))
    assert Coal(controller).distances(controller.robot.home, side).min() == pytest.approx(0.3, abs=0.05)
    assert beside < 1.5 * free + 1e-3


def test_when_reports_on_an_obstacle_end_the_arms_come_to_rest_and_the_controller_names_the_pair(
    controller: CartesianController,
) -> None:
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    far = start["left"].translation + np.array([0.0, 0.8, 0.0])
    controller.move_obstacle("hand", hand(far))
    references = [controller.step(circle(0.002 * tick, start), 0.002) for tick in range(1500)]
    assert np.abs(references[250].v).max() > 0.05
    assert np.abs(references[-1].v).max() < 1e-3
    assert references[-1].report.margin < 0.0
    assert "hand_0" in references[-1].report.tightest_pair
    controller.move_obstacle("hand", hand(far))
    assert max(np.abs(controller.step(circle(0.002 * tick, start), 0.002).v).max() for tick in range(250)) > 0.05


def test_if_a_hand_is_no_longer_reported_an_arm_moves_only_where_the_hand_cannot_have_arrived(
    controller: CartesianController,
) -> None:
    """The target is on the side away from the obstacle. The arm could reach the target if reports went on."""
    start, speed = controller.tool_pose("left"), 0.3
    reported, goal = start.translation + np.array([0.0, 0.4, 0.0]), start.translation - np.array([0.0, 0.3, 0.0])
    coal_distances, back, moved = Coal(controller), np.array([0.0, 1.0, 0.0]), 0.0
    controller.move_obstacle("hand", hand(reported, speed))
    for tick in range(1, 1501):
        time = 0.002 * tick
        away = {"left": pin.SE3(start.rotation, goal + 0.1 * math.sin(3.0 * time) * back)}
        reference = controller.step(away, 0.002)
        if np.abs(reference.v).max() > 1e-9:
            moved = time
            assert coal_distances.distances(reference.q, reported - speed * time * back).min() > 0.0
    assert 0.5 < moved < 1.3


def test_the_age_of_a_report_is_its_age_at_receipt_plus_the_durations_of_all_ticks_even_very_long_ticks(
    controller: CartesianController,
) -> None:
    at = controller.tool_pose("left").translation + np.array([0.0, 0.6, 0.0])
    controller.move_obstacle("hand", hand(at, speed=0.2, age=0.5))
    assert controller.obstacle_reports["hand"].age == 0.5
    controller.step({}, 0.002)
    controller.step({}, 0.3)  # The arms move for only 0.1 s, but the report gets 0.3 s older.
    assert controller.obstacle_reports["hand"].age == pytest.approx(0.802)
    controller.brake(0.05)
    assert controller.obstacle_reports["hand"].age == pytest.approx(0.852)


def test_a_new_obstacle_in_front_of_a_moving_arm_is_named_and_the_arm_brakes_along_its_certified_stop(
    controller: CartesianController,
) -> None:
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    forward = {"left": pin.SE3(start["left"].rotation, start["left"].translation + np.array([0.2, 0.0, 0.1]))}
    for _ in range(150):
        reference = controller.step(forward, 0.002)
    assert controller.move_obstacle("hand", hand(start["left"].translation + np.array([0.0, 0.9, 0.0]))) is None
    tool = controller.tool_pose("left").translation
    ahead = tool + np.array([RADIUS + 0.06, 0.0, 0.02])
    pair = controller.move_obstacle("hand", hand(ahead))
    assert pair is not None
    assert "hand_0" in pair
    longest = float((np.abs(reference.v) / controller.stop_deceleration).max())
    for _ in range(int(longest / 0.002) + 2):
        reference = controller.step(forward, 0.002)
        assert not reference.report.certified
    coal_distances = Coal(controller)
    before = coal_distances.distances(reference.q, ahead).min()
    for tick in range(300):
        if tick % 10 == 0:
            controller.move_obstacle("hand", hand(ahead))
        now = coal_distances.distances(controller.step(forward, 0.002).q, ahead).min()
        assert now >= before - 1e-9, "nothing moves towards it any more"
        before = now


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_only_an_obstacle_whose_reported_speed_is_0_counts_as_still(
    controller: CartesianController, speed: float
) -> None:
    reported = hand(np.array([0.0, 2.0, 0.5]), speed)
    controller.move_obstacle("hand", reported)
    assert controller.still_obstacles == ({"hand": reported} if speed == 0.0 else {})


def test_a_new_box_without_motion_stops_an_arm_like_a_fixed_obstacle_until_the_box_is_removed(
    controller: CartesianController,
) -> None:
    start = controller.tool_pose("left")
    place, goal = start.translation + np.array([0.0, 0.2, 0.0]), start.translation + np.array([0.0, 0.2, 0.0])
    box = MovingObstacle(shape="box", size=(0.1, 0.1, 0.4), position=tuple(place.tolist()), speed=0.0)
    assert controller.move_obstacle("hand", box) is None
    references = [controller.step({"left": pin.SE3(start.rotation, goal)}, 0.002) for _ in range(1500)]
    assert all(reference.report.certified for reference in references)
    assert np.abs(references[-1].v).max() < 5e-3
    buffer = controller.settings.distance_buffer
    assert references[-1].report.margin == pytest.approx(buffer, abs=1e-3)
    assert "hand_0" in references[-1].report.tightest_pair
    controller.move_obstacle("hand", None)
    assert controller.moving_obstacles == {}
    for _ in range(1500):
        controller.step({"left": pin.SE3(start.rotation, goal)}, 0.002)
    assert np.linalg.norm(controller.tool_pose("left").translation - goal) < 2e-3


def test_if_a_hand_is_too_near_to_an_arm_this_arm_can_only_move_away_and_the_other_arm_moves_freely(
    controller: CartesianController,
) -> None:
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    near = start["left"].translation + np.array([0.0, RADIUS + 0.08, 0.0])
    controller.move_obstacle("hand", hand(near))
    for _ in range(250):
        controller.move_obstacle("hand", hand(near))
        controller.step({}, 0.002)
    assert np.linalg.norm(controller.tool_pose("left").translation - start["left"].translation) < 1e-3, "not pushed"
    towards = {"left": pin.SE3(start["left"].rotation, near), "right": circle(0.3, start)["right"]}
    for _ in range(500):
        controller.move_obstacle("hand", hand(near))
        controller.step(towards, 0.002)
    assert np.linalg.norm(controller.tool_pose("right").translation - towards["right"].translation) < 5e-3
    assert np.linalg.norm(controller.tool_pose("left").translation - start["left"].translation) < 5e-3
    away = {"left": pin.SE3(start["left"].rotation, start["left"].translation - np.array([0.0, 0.1, 0.0]))}
    for _ in range(1500):
        controller.move_obstacle("hand", hand(near))
        controller.step(away, 0.002)
    assert np.linalg.norm(controller.tool_pose("left").translation - away["left"].translation) < 5e-3


def test_the_values_slower_and_rise_of_an_obstacle_are_computed_from_its_speeds_and_its_acceleration() -> None:
    made = hand(np.zeros(3), 1.0, acceleration=2.0, speed_now=0.2)
    assert (made.slower, made.rise) == pytest.approx((0.8, 0.4))
    assert hand(np.zeros(3), 1.0, acceleration=2.0).slower == 0.0
    assert hand(np.zeros(3), 1.0, speed_now=0.2).slower == 0.0


def test_without_moving_obstacles_the_arrays_of_kernels_have_no_entries_for_such_obstacles() -> None:
    robot = robot_of_cell()
    without, one = (
        kernel_model_of(robot, ControllerSettings(moving_obstacles=names)).safety for names in ((), ("hand",))
    )
    assert len(without.min_distance) == len(robot.collision_model.collisionPairs)
    bodies = sum(item.parentJoint > 0 for item in robot.collision_model.geometryObjects)
    assert len(one.min_distance) == len(without.min_distance) + bodies
    np.testing.assert_array_equal(one.min_distance[: len(without.min_distance)], without.min_distance)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        pytest.param({"shape": "cone", "size": (0.1,), "speed": 0.1}, "shape", id="a shape that is none"),
        pytest.param({"shape": "sphere", "size": (0.1,)}, "speed: missing", id="no speed"),
        pytest.param({"shape": "box", "size": (0.1,), "speed": 0.1}, "size", id="a box with one side"),
        pytest.param({"shape": "sphere", "size": (0.1,), "speed": float("inf")}, "speed", id="any speed"),
        pytest.param({"shape": "sphere", "size": (0.1,), "speed": 0.1, "speed_now": 0.2}, "speed_now", id="too fast"),
    ],
)
def test_an_invalid_obstacle_raises_an_error_that_names_the_wrong_key(values: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        MovingObstacle(**values)


def test_a_moving_obstacle_with_an_unknown_name_or_the_name_of_a_fixed_obstacle_is_refused(
    controller: CartesianController,
) -> None:
    with pytest.raises(ConfigError, match="'foot': allowed: hand"):
        controller.move_obstacle("foot", hand(np.zeros(3)))
    with pytest.raises(ConfigError, match="table"):
        CartesianController(controller.robot, ControllerSettings(moving_obstacles=("table",)))
