"""The pairs that are measured to predict collisions, and the distances that these pairs keep."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.obstacle_bodies import with_obstacle_bodies
from q2r2_control.robot.robot import Robot
from tests.control.hunted_arms import RADIUS, controller_at_home, hand
from tests.support.object_cell import BLOCK, cell


def least_ahead(controller: CartesianController) -> float:
    distances, kept = controller.pairs_ahead(0.05)
    return float((distances(controller.step({}, 0.0).q) - kept).min())


def test_beside_a_moving_hand_a_prediction_finds_the_same_margin_as_the_report() -> None:
    controller = controller_at_home()
    side = controller.tool_pose("left").translation + np.array([0.0, RADIUS + 0.12, 0.0])
    controller.move_obstacle("hand", hand(side))
    for _ in range(250):
        controller.move_obstacle("hand", hand(side))
        reference = controller.step({}, 0.002)
    assert "hand_0" in reference.report.tightest_pair
    assert least_ahead(controller) == pytest.approx(reference.report.margin, abs=1e-6)
    controller.move_obstacle("hand", None)
    distances, kept = controller.pairs_ahead(0.05)
    np.testing.assert_array_equal(kept, controller.kept_distances)
    np.testing.assert_allclose(distances(reference.q), controller.robot.distance_values(reference.q), atol=2e-6)


def test_a_prediction_includes_the_distances_of_a_held_box() -> None:
    config = cell(BLOCK)
    robot = Robot.from_config(config)
    settings = config.control.timed(realtime=False).model_copy(update={"moving_obstacles": ("hand",)})
    geometry, plain = with_obstacle_bodies(robot, ("hand",)), with_obstacle_bodies(robot, ())
    assert plain is robot.objects.geometry
    hull = [item for item in geometry.geometryObjects if "hull" in item.name]
    assert [item.name for item in hull] == ["left_object_hull"]
    half = 0.5 * np.array(BLOCK["box"])
    across = np.sqrt((half**2).sum() - half.max() ** 2)
    assert hull[0].geometry.radius >= across - 1e-6
    controller = CartesianController(robot, settings)
    below = controller.tool_pose("left").act(np.array([0.0, 0.0, 0.05 + RADIUS]))
    controller.move_obstacle("hand", hand(below, speed=0.0))
    before = controller.step({}, 0.002).report
    least = [least_ahead(controller)]
    controller.set_holding("left", True)
    after = controller.step({}, 0.002).report
    least.append(least_ahead(controller))
    assert least == pytest.approx([before.margin, after.margin], abs=1e-6)
    assert after.margin < before.margin
    assert "left_object_hull" in after.tightest_pair
