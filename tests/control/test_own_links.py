"""An arm's own links: watched as others are, and no reason to move slowly."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config

CONFIG = load_config("config/dual_iiwa7.yaml")
SETTINGS = CONFIG.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock
LEAST = SETTINGS.min_distance
HAND_AND_FOREARM = ("left_link_5_0", "left_hand_e_envelope_0")
A6 = 5


@pytest.fixture(scope="module")
def controller() -> CartesianController:
    return CartesianController(Robot.from_config(CONFIG), SETTINGS)


def test_a_target_that_bends_the_hand_to_the_forearm_is_followed_to_the_distance_that_is_kept(
    controller: CartesianController,
) -> None:
    robot = controller.robot
    controller.reset(robot.home)
    inwards = pin.SE3(pin.rpy.rpyToMatrix(0.0, 1.2, 0.0), np.zeros(3))
    target = {"left": controller.tool_pose("left") * inwards}
    nearest = np.inf
    for _ in range(2000):
        reference = controller.step(target, 2e-3)
        assert reference.report.certified
        nearest = min(nearest, robot.distance_values(reference.q).min())
    assert LEAST <= nearest < LEAST + 0.01
    assert reference.report.closest_pair == HAND_AND_FOREARM


def test_a_circle_is_followed_no_worse_because_the_hand_is_near_its_own_forearm(
    controller: CartesianController,
) -> None:
    """Half a metre in the air with 0.3 m/s, 6 mm of free distance at its top."""
    controller.reset(controller.robot.home)
    start, errors, nearest = controller.tool_pose("left"), [], np.inf
    for tick in range(4000):
        phase = np.pi * tick * 1e-3
        by = np.array([0.0, 0.1 * np.sin(phase), 0.1 * (1.0 - np.cos(phase))])
        report = controller.step({"left": pin.SE3(start.rotation, start.translation + by)}, 1e-3).report
        nearest = min(nearest, report.closest_distance)
        if tick > 1000:
            errors.append(np.linalg.norm(controller.tool_pose("left").translation - start.translation - by))
    assert nearest < LEAST + 0.01
    assert np.sqrt(np.mean(np.square(errors))) < 0.004
