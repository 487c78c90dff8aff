"""Targets below the floor: arms stay above it, and say that it is the floor which holds them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import Reference
from q2r2_control.wording import limit_name

CONFIG = load_config("config/dual_iiwa7.yaml")
SETTINGS = CONFIG.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock
FRAME_TO_TIPS = 0.013  # of a tool [m]
DT = 0.002
DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # as at home
BESIDE_THE_TABLE = {
    "left": pin.SE3(DOWN, np.array([0.1, 1.0, -0.3])),
    "right": pin.SE3(DOWN, np.array([0.1, -1.0, -0.3])),
}


def _controller(floor: float | None) -> CartesianController:
    robot = Robot.from_config(CONFIG.model_copy(update={"floor": floor}))
    return CartesianController(robot, SETTINGS)


def _driven(controller: CartesianController, seconds: float) -> Iterator[Reference]:
    for _ in range(round(seconds / DT)):
        yield controller.step(BESIDE_THE_TABLE, DT)


def _height(controller: CartesianController, arm: str) -> float:
    return float(controller.tool_pose(arm).translation[2])


@pytest.mark.parametrize("floor", [0.0, -0.15])
def test_every_link_keeps_off_the_floor_at_every_tick_and_the_arms_come_to_rest_above_it(floor: float) -> None:
    controller = _controller(floor)
    accelerations, kept = [], kept_distances(controller.robot, SETTINGS).values
    for reference in _driven(controller, 4.0):
        assert reference.report.certified
        # As exactly as Coal measures a box.
        assert (controller.robot.distance_values(reference.q) >= kept - 2e-6).all()
        assert min(_height(controller, arm) for arm in ("left", "right")) > floor + FRAME_TO_TIPS
        accelerations.append(reference.a)
    assert np.sqrt(np.mean(np.square(accelerations[-250:]), axis=0)).max() < 0.1
    assert "floor_0" in reference.report.closest_pair
    for arm in ("left", "right"):
        assert _height(controller, arm) < floor + FRAME_TO_TIPS + 0.002, "down to where the floor stops it"


def _hands_in_the_table(depth: float) -> np.ndarray:
    """A posture with both tools pointing down ``depth`` [m] below the table's surface, its links with them."""
    ghost = Robot.from_config(CONFIG)
    ghost.collision_model.removeAllCollisionPairs()
    controller = CartesianController(ghost, SETTINGS)
    targets = {arm: controller.tool_pose(arm) for arm in ghost.arms}
    for pose in targets.values():
        pose.translation = np.array([*pose.translation[:2], 0.2 - depth])
    for _ in range(2000):
        reference = controller.step(targets, DT)
    return reference.q


@pytest.mark.parametrize("depth", [0.12, 0.18])
def test_hands_and_wrists_deep_in_the_table_come_out_through_its_top(depth: float) -> None:
    """The way out of a hand alone would be the underside, where the floor is, and the wrists' would be the top."""
    controller = _controller(0.0)
    home = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    controller.reset(_hands_in_the_table(depth))
    least, ticks = -np.inf, 0
    while ticks < 500:
        report = controller.step(home, DT).report
        assert report.closest_distance >= least - 1e-9, "it comes closer"
        least, ticks = report.closest_distance, ticks + 1
        if report.certified:
            break
    assert report.certified


def test_where_nothing_can_be_certified_the_report_names_the_pairs_that_hold_the_arms() -> None:
    """Without a floor the underside is a way out, and hand and wrist hold each other in the table."""
    controller = _controller(None)
    home = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    controller.reset(_hands_in_the_table(0.12))
    for _ in range(50):
        report = controller.step(home, DT).report
    assert report.fallback
    assert not report.certified
    too_close = {"left_hand_e_envelope_0|table_0", "left_link_7_0|table_0", "right_hand_e_envelope_0|table_0"}
    assert too_close <= set(map(limit_name, report.binding))
