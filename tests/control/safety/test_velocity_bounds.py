from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.safety.velocity_bounds import fastest_approach
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, distances, kernel_data, kernel_model, random_posture

STEP = 1e-6  # of finite differences [s]


def bounds_at(name: str, q: Array, v: Array) -> Array:
    """Fastest approach (p,) of every pair [m/s]."""
    model, data = kernel_model(name).safety.collision, kernel_data(name, q, v).safety
    pairs = zip(model.pairs.first, model.pairs.second, strict=True)
    return np.array([fastest_approach(data.velocities, first, second) for first, second in pairs])


@pytest.mark.parametrize("name", NAMES)
def test_no_pair_closes_in_faster_than_its_bound_and_some_come_near_it(name: str) -> None:
    random, robot = np.random.default_rng(51), cell(name).robot
    nearest = 0.0
    for _ in range(30):
        q, v = random_posture(robot, random), random.uniform(-robot.velocity_limit, robot.velocity_limit)
        before, after = distances(cell(name), np.array([q - STEP * v, q + STEP * v]))
        closing, bounds = (before - after) / (2 * STEP), bounds_at(name, q, v)
        apart = np.minimum(before, after) > 0.0
        assert (closing[apart] <= bounds[apart] + 1e-6).all()
        nearest = max(nearest, float((closing[apart] / np.maximum(bounds[apart], 0.1)).max()))
    assert nearest > 0.7
