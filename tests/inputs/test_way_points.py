"""Way points: the hand rests at each, and moves calmly between them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.inputs.assembly import WayPoints, minimum_jerk

WAY = WayPoints([(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (2.0, 0.1, 0.0, 0.2, 0.0, 0.0), (4.0, 0.1, -0.3, 0.2, 0.4, 1.2)])


@pytest.mark.parametrize(
    ("t", "place", "turn"),
    [
        pytest.param(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), id="it waits at the first"),
        pytest.param(1.5, (0.05, 0.0, 0.1), (0.0, 0.0, 0.0), id="it is half-way at half the time"),
        pytest.param(2.0, (0.1, 0.0, 0.2), (0.0, 0.0, 0.0), id="it is at each in time"),
        pytest.param(9.0, (0.1, -0.3, 0.2), (0.4, 0.0, 1.2), id="it stays at the last"),
    ],
)
def test_the_hand_is_where_its_way_points_say(
    t: float, place: tuple[float, ...], turn: tuple[float, float, float]
) -> None:
    where, rotation = WAY.at(t)
    np.testing.assert_allclose(where, place, atol=1e-12)
    tilted = pin.rpy.rpyToMatrix(turn[0], 0.0, 0.0) @ pin.rpy.rpyToMatrix(0.0, 0.0, turn[2])
    np.testing.assert_allclose(pin.exp3(rotation), tilted, atol=1e-12)


@pytest.mark.parametrize("t", [1.0, 2.0, 4.0])
def test_it_rests_at_every_way_point(t: float) -> None:
    before, after = WAY.at(t - 1e-4)[0], WAY.at(t + 1e-4)[0]
    assert np.linalg.norm(after - before) / 2e-4 < 1e-5


def test_minimum_jerk_is_cut_to_its_ends() -> None:
    assert [minimum_jerk(fraction) for fraction in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]
