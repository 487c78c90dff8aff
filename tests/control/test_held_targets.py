"""Targets that come less often than steps are interpolated. All other targets are passed on unchanged."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.control.held_targets import LONGEST_HOLD, HeldTargets
from q2r2_control.types import Array
from tests.support.processes import cell

DT = 0.001  # [s]
LIMIT = 10.0  # The limit of a joint's acceleration [rad/s^2].


def pose(x: float, turn: float = 0.0) -> pin.SE3:
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, turn])), np.array([x, 0.0, 0.0]))


def followed(held: HeldTargets, given: pin.SE3) -> pin.SE3:
    found = held.between({"left": given}, DT)["left"]
    assert found is not None
    return found


@pytest.mark.parametrize("rate", [20.0, 90.0, 300.0])
def test_a_stream_of_targets_is_followed_on_a_straight_line_at_the_speed_of_the_stream(rate: float) -> None:
    held, way = HeldTargets(), list[float]()
    for step in range(1000):
        sample = math.floor(step * DT * rate) / rate
        found = followed(held, pose(0.2 * sample, 0.6 * sample))
        way.append(found.translation[0])
        assert pin.log3(found.rotation)[2] == pytest.approx(3.0 * found.translation[0], abs=1e-9)
    speed = np.diff(way[300:]) / DT
    assert np.abs(speed - 0.2).max() < 0.08
    late = np.arange(300, 1000) * DT - np.array(way[300:]) / 0.2
    assert late.max() < 2.3 / rate


def test_a_target_is_passed_on_at_once_if_every_step_has_a_new_target_or_the_last_target_was_held_long() -> None:
    held = HeldTargets()
    for step in range(20):
        assert followed(held, new := pose(0.001 * step)) == new
    for _ in range(round(LONGEST_HOLD / DT) + 2):
        assert followed(held, rest := pose(0.3)) == rest
    assert followed(held, jump := pose(0.6)) == jump


def test_the_interpolated_target_arrives_at_a_held_target_and_then_stays_there() -> None:
    held = HeldTargets()
    for goal in (0.0, 0.1, 0.2):
        found = [followed(held, pose(goal)).translation[0] for _ in range(10)]
    assert 0.08 < found[0] < 0.1, "0.1 m is not reached yet when 0.2 m comes"
    assert followed(held, pose(0.2)).translation[0] < 0.2, "1.25 times as long as the last one was held"
    assert [followed(held, pose(0.2)) for _ in range(5)][-1] == pose(0.2)


def test_a_pose_object_that_was_changed_in_place_counts_as_a_new_target() -> None:
    held, mine = HeldTargets(), pose(0.0)
    for _ in range(10):
        followed(held, mine)
    mine.translation[:] = (0.5, 0.0, 0.0)
    assert 0.0 < followed(held, mine).translation[0] < 0.1


SCALED, MIRRORED = (pin.SE3(factor * np.eye(3), np.zeros(3)) for factor in (1.01, -1.0))


@pytest.mark.parametrize(
    "other",
    [None, "no pose", pose(math.nan), pose(1e200), SCALED, MIRRORED],
    ids=["None", "a text", "not finite", "far away", "scaled", "mirrored"],
)
def test_an_invalid_target_and_the_target_after_it_are_passed_on_unchanged(other: object) -> None:
    held = HeldTargets()
    given: Any
    for given in (pose(0.0), pose(0.1), other):
        for _ in range(10):
            found = held.between({"left": given, "right": pose(0.0)}, DT)
    assert found["left"] is other
    assert followed(held, new := pose(0.5)) == new
    assert list(held.between({"left": new}, DT)) == ["left"]


def test_after_a_step_without_a_target_the_next_target_is_passed_on_at_once() -> None:
    held = HeldTargets()
    for _ in range(10):
        followed(held, pose(0.0))
    held.between({}, DT)
    assert followed(held, new := pose(0.5)) == new


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(cell())


def velocities(controller: CartesianController, steps: int, ask: bool = False) -> list[Array]:
    """Return the joint velocities while a target moves along a sine at up to 0.2 m/s, with 90 samples a second.

    With ``ask``, the problem of each step is read before the step.
    """
    controller.reset(controller.robot.home)
    start, found = controller.tool_pose("left"), []
    for step in range(steps):
        t = math.floor(step * DT * 90.0) / 90.0
        target = pin.SE3(start.rotation, start.translation + np.array([0.0, 0.1 * math.sin(2.0 * t), 0.0]))
        if ask:
            controller.problem({"left": target}, DT)
        found.append(controller.step({"left": target}, DT).v)
    return found


@pytest.mark.parametrize("bridged", [True, False])
def test_joints_are_hardly_ever_at_their_acceleration_limit_if_held_targets_are_interpolated(
    robot: Robot, bridged: bool
) -> None:
    settings = ControllerSettings(acceleration_limit=LIMIT)
    controller = CartesianController(robot, settings, bridge_held=bridged)
    acceleration = np.abs(np.diff(np.array(velocities(controller, 1500)[300:]), axis=0)).max(axis=1) / DT
    share = float((acceleration > 0.99 * LIMIT).mean())
    assert share < 0.05 if bridged else share > 0.5


def test_reading_the_problem_between_steps_does_not_change_the_interpolation_of_targets(robot: Robot) -> None:
    controller = CartesianController(robot, ControllerSettings(acceleration_limit=LIMIT))
    np.testing.assert_array_equal(velocities(controller, 40), velocities(controller, 40, ask=True))
