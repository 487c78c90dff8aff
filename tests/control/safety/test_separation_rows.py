from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.safety.separation_rows import slowest_rate, write_separation_rows
from q2r2_control.control.safety.velocity_bounds import update_body_velocities
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, distances, kernel_data, kernel_model, random_posture

APPROACH = kernel_model("dual_iiwa7").safety.approach


class Seen:
    """What :func:`write_separation_rows` finds in one state."""

    def __init__(self, name: str, q: Array, v: Array) -> None:
        model, data = kernel_model(name).safety, kernel_data(name, q, v).safety
        update_body_velocities(model.collision, data.collision, v, data.velocities)
        self.closest = write_separation_rows(model, data)
        self.distance, rows = data.distance, data.rows
        used = int(rows.used[0])
        self.matrix, self.lower, self.pair = rows.matrix[:used], rows.lower[:used], rows.pair[:used]


def _state(name: str, seed: int, speed: float) -> tuple[Array, Array]:
    random, robot = np.random.default_rng(seed), cell(name).robot
    return random_posture(robot, random), speed * random.uniform(-robot.velocity_limit, robot.velocity_limit)


SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS, name=st.sampled_from(NAMES), speed=st.floats(0.0, 1.0))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_distances_are_exact_where_they_matter_and_never_too_large(seed: int, name: str, speed: float) -> None:
    q, v = _state(name, seed, speed)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    assert (seen.distance <= exact + 1e-12).all()
    round_pair = cell(name).pairs.round == 1
    matters = (exact <= APPROACH.stop_distance) | (round_pair & (exact <= APPROACH.slow_below))
    np.testing.assert_allclose(seen.distance[matters], exact[matters], rtol=0, atol=1e-12)
    assert seen.distance[seen.closest] == pytest.approx(exact.min(), abs=1e-12)
    # The stop certificate takes a bound below the least distance for a pair that is too close.
    assert (seen.distance[~matters] > APPROACH.stop_distance).all()


@given(seed=SEEDS, name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_every_pair_that_is_too_close_is_asked_to_part_at_bounded_speed(seed: int, name: str) -> None:
    q, v = _state(name, seed, 0.0)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    for p in np.flatnonzero(exact < APPROACH.stop_distance - 1e-3):
        lower = seen.lower[seen.pair == p]
        assert len(lower)
        assert (lower > 0.0).any()
    assert (seen.lower <= APPROACH.recovery_speed).all()


@given(seed=SEEDS, name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_a_row_tells_how_fast_its_pair_comes_closer(seed: int, name: str) -> None:
    q, v = _state(name, seed, 0.3)
    seen, step = Seen(name, q, v), 1e-6
    before, here, after = distances(cell(name), np.array([q - step * v, q, q + step * v]))
    rates = (after - before) / (2 * step)
    for p in set(seen.pair.tolist()):
        smooth = abs((after - here)[p] - (here - before)[p]) < 1e-9
        # The first row of a pair is that of its closest points.
        if smooth and here[p] > -0.03:
            assert seen.matrix[seen.pair == p][0] @ v == pytest.approx(rates[p], abs=1e-4)


@given(seed=SEEDS, name=st.sampled_from(NAMES), speed=st.floats(0.0, 1.0))
@settings(derandomize=True, max_examples=40, deadline=None)
def test_rows_are_finite_and_none_is_empty(seed: int, name: str, speed: float) -> None:
    q, v = _state(name, seed, speed)
    seen = Seen(name, q, v)
    assert len(seen.pair) <= 5 * len(cell(name).pairs.first)
    assert np.isfinite(seen.matrix).all()
    assert np.isfinite(seen.lower).all()
    assert (np.linalg.norm(seen.matrix, axis=1) > 0.0).all()


@given(alpha=st.floats(1e-3, 20.0), free=st.floats(0.0, 1.0))
@settings(derandomize=True, max_examples=200, deadline=None)
def test_a_pair_may_close_in_no_faster_than_it_can_be_stopped(alpha: float, free: float) -> None:
    closing = -slowest_rate(free, alpha, APPROACH)
    assert 0.0 <= closing <= APPROACH.gain * free
    assert closing**2 / (2 * alpha) <= free * (1 + 1e-9)


def test_a_pair_that_closes_in_as_fast_as_it_may_ends_at_the_buffer() -> None:
    free, dt = 0.5, 1e-3
    for _ in range(5000):
        free += slowest_rate(free, 2.0, APPROACH) * dt
        assert free >= 0.0
    assert free < 1e-4


def test_closer_than_the_buffer_a_pair_opens_faster_the_deeper_it_is_up_to_the_recovery_speed() -> None:
    rates = [slowest_rate(free, 1.0, APPROACH) for free in (0.0, -0.001, -0.005, -0.1, -1.0)]
    assert rates[0] == 0.0
    assert rates == sorted(rates)
    assert rates[1:] == pytest.approx([0.004, 0.02, 0.05, 0.05])
