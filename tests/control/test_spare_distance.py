"""How much nearer an arm may come to what is no part of it, against every distance of the robot's model."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot, load_config
from q2r2_control.types import Array
from tests.support.object_cell import BLOCK
from tests.support.object_cell import cell as object_cell

KEPT = 0.03  # by every pair of the cell [m]


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, ControllerSettings(min_distance=KEPT))


def postures(robot: Robot, count: int) -> list[Array]:
    random = np.random.default_rng(5)
    return [robot.home + random.normal(0.0, 0.4, len(robot.home)) for _ in range(count)]


def expected(robot: Robot, arm: str, q: Array) -> float:
    """Links are named by their arm; the table and the floor are nobody's."""
    pairs = robot.distances(q)
    mine = [(pair.name_a.startswith(arm), pair.name_b.startswith(arm), pair.distance) for pair in pairs]
    return min(distance for a, b, distance in mine if a != b) - KEPT


def test_it_is_the_least_of_the_arm_s_pairs_with_others_less_what_they_keep(
    robot: Robot, controller: CartesianController
) -> None:
    seen = set()
    for q in postures(robot, 60):
        controller.reset(q)
        for arm in robot.arms:
            spare = controller.spare_distance(arm)
            assert spare == pytest.approx(expected(robot, arm, q), abs=1e-6)
            seen.add(round(spare, 6))
    assert len(seen) > 60  # the arms differ from each other, and the postures do


def test_an_object_that_is_held_is_part_of_its_arm() -> None:
    cell = object_cell(BLOCK, BLOCK)
    controller = CartesianController(Robot.from_config(cell), cell.control)
    empty = controller.spare_distance("left")
    controller.set_opening("left", 0.0, 1.0)
    controller.set_holding("left", True)
    for _ in range(100):
        controller.step({}, 0.004)
    assert controller.holding["left"]
    assert controller.spare_distance("left") <= empty
