"""The bound on how far an obstacle has moved since its report is the distance of its fastest allowed motion."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.safety.protective_distance import ObstacleData, reach
from tests.control.cells import behind


@pytest.mark.parametrize("slower", [0.0, 0.1, 0.5], ids="slower by {} m/s".format)
def test_the_reach_of_an_obstacle_is_the_distance_of_its_fastest_allowed_motion(slower: float) -> None:
    """From its report on, the obstacle accelerates at a constant rate until it has its greatest speed."""
    speed, rise = 0.5, 0.2
    empty, none = np.zeros(1), np.zeros(2, dtype=np.int64)
    bounds_of_speed = np.full(1, speed), np.full(1, slower), np.full(1, rise)
    obstacles = behind(ObstacleData(none, *bounds_of_speed, empty, empty, empty, empty, empty))
    t = np.linspace(0.0, 0.6, 3001)
    speeds = speed - slower * np.clip(1.0 - t / rise, 0.0, 1.0)
    moved = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(t))])
    bounds = np.array([reach(obstacles, 0, instant) for instant in t])
    np.testing.assert_allclose(bounds, moved, rtol=0, atol=1e-7)
