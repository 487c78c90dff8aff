from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel, update_placements
from q2r2_control.control.geometry.pair_distance import at_least, deepest, measure, with_rounded_boxes
from q2r2_control.robot.pairs import pair_names
from q2r2_control.types import Array
from tests.control.cells import cell, random_posture

ROBOT, MODEL = cell("dual_iiwa7").robot, cell("dual_iiwa7").collision
NAMES = pair_names(ROBOT.collision_model)
DEPTH = 0.015  # [m]
TOUCHING = np.array(["finger" in a + b and "table" in a + b for a, b in NAMES])
ROUNDED = with_rounded_boxes(MODEL, np.where(TOUCHING, DEPTH, -0.02))


def measured(model: CollisionModel, q: Array) -> tuple[Array, Array]:
    """Every pair's distance and lower bound at a posture."""
    data = CollisionData.empty(model)
    update_placements(model, data, q)
    count = len(NAMES)
    bound = np.array([at_least(model, data, p) for p in range(count)])
    return np.array([measure(model, data, p) for p in range(count)]), bound


@pytest.mark.parametrize("seed", range(20))
def test_only_pairs_with_a_depth_see_a_rounded_box_and_never_a_larger_one(seed: int) -> None:
    q = random_posture(ROBOT, np.random.default_rng(seed))
    (distance, _), (rounded, bound) = measured(MODEL, q), measured(ROUNDED, q)
    np.testing.assert_array_equal(rounded[~TOUCHING], distance[~TOUCHING])
    more = (rounded - distance)[TOUCHING]
    # Corners lose sqrt(3) - 1 of the radius, and what is deep inside is nearer to the smaller core's other sides.
    assert (more > -1e-9).all()
    outside = distance[TOUCHING] > 0.0
    assert (more[outside] <= (np.sqrt(3.0) - 1.0) * DEPTH + 1e-9).all()
    assert (bound <= rounded + 1e-9).all()


def test_above_the_face_of_a_box_nothing_changes() -> None:
    (distance, _), (rounded, _) = measured(MODEL, ROBOT.home), measured(ROUNDED, ROBOT.home)
    np.testing.assert_allclose(rounded[TOUCHING], distance[TOUCHING], atol=1e-12)


def test_the_cores_of_pairs_with_a_depth_are_that_much_farther_apart() -> None:
    rounded = deepest(ROUNDED, ROUNDED.bodies.radius) - deepest(MODEL, MODEL.bodies.radius)
    np.testing.assert_allclose(rounded[TOUCHING], DEPTH)
