"""A step that came too late for the plant is undone, and the arms brake from the state before this step."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Reference

DT = 0.002


def crossing(controller: CartesianController) -> dict[str, pin.SE3 | None]:
    """Return a target for each tool, at the present position of the other tool."""
    left, right = (controller.tool_pose(arm) for arm in SIDES)
    return {"left": pin.SE3(left.rotation, right.translation), "right": pin.SE3(right.rotation, left.translation)}


def moving(robot: Robot) -> tuple[CartesianController, Reference]:
    """Return a controller whose arms move towards each other, and its last reference."""
    controller = CartesianController(robot)
    targets = crossing(controller)
    return controller, [controller.step(targets, DT) for _ in range(100)][-1]


def test_an_undone_step_leaves_the_reference_and_its_certified_stop_unchanged(robot: Robot) -> None:
    controller, before = moving(robot)
    stop = controller.stop_deceleration
    late = controller.step(crossing(controller), DT)
    assert np.abs(late.q - before.q).max() > 1e-4
    controller.withdraw(late)
    np.testing.assert_array_equal(late.q, before.q)
    np.testing.assert_array_equal(late.v, before.v)
    np.testing.assert_array_equal(controller.stop_deceleration, stop)
    np.testing.assert_allclose(controller.tool_pose("left"), robot.tool_pose(before.q, "left"), atol=1e-9)


def test_after_an_undone_step_no_pair_keeps_a_greater_distance_than_before_the_step(robot: Robot) -> None:
    controller = CartesianController(robot)
    controller.step({}, DT)
    assert controller.change({"min_distance": controller.settings.min_distance + 0.01}) is None
    before, late = controller.kept_distances, controller.step({}, DT)
    # Kept distances do not grow at every step. The loop ends at a step in which one of them grew.
    while not (controller.kept_distances > before).any():
        before, late = controller.kept_distances, controller.step({}, DT)
    controller.withdraw(late)
    np.testing.assert_array_equal(controller.kept_distances, before)


@pytest.mark.slow
def test_arms_that_move_towards_each_other_keep_limits_and_distances_although_some_steps_are_late(robot: Robot) -> None:
    controller, random = CartesianController(robot), np.random.default_rng(0)
    cap = robot.capped_acceleration(controller.settings.acceleration_limit)
    targets, before = crossing(controller), Reference(robot.home, np.zeros_like(robot.home), robot.home, None)  # type: ignore[arg-type]
    nearest = np.inf
    for tick in range(3000):
        braked = 0.0
        if tick and random.random() < 0.3:
            controller.withdraw(before)
            braked = float(random.uniform(0.0, 0.01))
            controller.brake(braked)
        reference = controller.step(targets, DT)
        assert reference.report.certified
        limit = cap * (braked + DT) + 1e-9
        assert (np.abs(reference.v - before.v) <= limit).all()
        nearest = min(nearest, (robot.distance_values(reference.q) - controller.kept_distances).min())
        before = reference
    assert -1e-9 <= nearest < 0.01


def test_a_braking_step_follows_the_certified_stop_and_can_be_undone(robot: Robot) -> None:
    controller, before = moving(robot)
    deceleration = controller.stop_deceleration
    braked = controller.brake(DT)
    np.testing.assert_allclose(braked.a, -np.sign(before.v) * deceleration, atol=1e-6)
    assert braked.report.certified
    controller.withdraw(braked)
    np.testing.assert_array_equal(braked.q, before.q)
    while np.abs(braked.v).max() > 0.0:
        braked = controller.brake(DT)
    np.testing.assert_array_equal(controller.brake(DT).q, braked.q)
