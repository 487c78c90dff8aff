from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.safety.safety_filter import measure_pairs
from q2r2_control.control.safety.separation_rows import write_separation_rows
from q2r2_control.control.safety.speed_bound import update_body_velocities
from q2r2_control.control.safety.stop_rollout import TOGETHER, write_stop
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, distances, kernel_data, kernel_model, random_posture

APPROACH = kernel_model("dual_iiwa7").safety.approach
STOP_DISTANCE = float(APPROACH.stop_distance[0])
H = 0.001


class Seen:
    """The measured distances and the written rows in one state. In the known stop, all joints stop together."""

    def __init__(self, name: str, q: Array, v: Array) -> None:
        model, data = kernel_model(name).safety, kernel_data(name, q, v).safety
        update_body_velocities(model.collision, data.collision, v, data.velocities)
        write_stop(model, q, v, TOGETHER, data.certified)
        self.closest = measure_pairs(model, data)
        write_separation_rows(model, data, H)
        self.distance, self.near, rows = data.distance, data.near, data.rows
        used = int(rows.used[0])
        self.matrix, self.lower, self.pair = rows.matrix[:used], rows.lower[:used], rows.pair[:used]
        np.testing.assert_allclose(np.linalg.norm(self.matrix, axis=1), 1.0, rtol=0, atol=1e-9)
        self.duration = float(np.max(np.abs(v) / data.certified))


def _state(name: str, seed: int, speed: float) -> tuple[Array, Array]:
    random, robot = np.random.default_rng(seed), cell(name).robot
    return random_posture(robot, random), speed * random.uniform(-robot.velocity_limit, robot.velocity_limit)


SEEDS = st.integers(0, 2**32 - 1)


@given(seed=SEEDS, name=st.sampled_from(NAMES), speed=st.floats(0.0, 1.0))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_distances_of_near_pairs_are_exact_and_other_distances_are_never_too_large(
    seed: int, name: str, speed: float
) -> None:
    q, v = _state(name, seed, speed)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    assert (seen.distance <= exact + 1e-12).all()
    matters = exact <= STOP_DISTANCE
    np.testing.assert_allclose(seen.distance[matters], exact[matters], rtol=0, atol=1e-12)
    assert seen.distance[seen.closest] == pytest.approx(exact.min(), abs=1e-12)
    # For far pairs only a lower bound of the distance is computed. If this bound were below the stop distance, the stop
    # certificate would count the pair as too close.
    assert (seen.distance[~matters] > STOP_DISTANCE).all()


@given(seed=SEEDS, name=st.sampled_from(NAMES), speed=st.floats(0.05, 1.0))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_a_pair_that_approaches_fast_is_examined_early_enough(seed: int, name: str, speed: float) -> None:
    q, v = _state(name, seed, speed)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    before, after = distances(cell(name), q + 1e-6 * np.array([[-1.0], [1.0]]) * v)
    closing = np.maximum((before - after) / 2e-6, 0.0)
    in_time = STOP_DISTANCE + (2.0 / APPROACH.gain + 0.5 * seen.duration) * closing
    assert seen.near[exact < in_time - 1e-4].all()


@given(seed=SEEDS, name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=40, deadline=None)
def test_for_arms_at_rest_a_pair_counts_as_near_exactly_if_one_step_can_make_its_rows_necessary(
    seed: int, name: str
) -> None:
    q, v = _state(name, seed, 0.0)
    seen, exact, model = Seen(name, q, v), distances(cell(name), q[None])[0], kernel_model(name).safety
    approach, surge = model.approach, float(np.max(model.limits.acceleration)) * model.limits.longest_step
    reach = (2.0 / approach.gain[0]) * model.collision.pairs.leverage * surge
    needed = approach.stop_distance + approach.contact_zone + reach
    assert seen.near[exact < needed - 1e-6].all()
    assert not seen.near[exact > needed + 1e-6].any()


def _gradient(name: str, q: Array, p: int) -> Array:
    step = 1e-6 * np.eye(len(q))
    return np.asarray((distances(cell(name), q + step) - distances(cell(name), q - step))[:, p] / 2e-6)


@given(seed=SEEDS, name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=80, deadline=None)
def test_every_pair_that_is_too_close_gets_a_row_that_opens_it_at_bounded_speed(seed: int, name: str) -> None:
    q, v = _state(name, seed, 0.0)
    seen, exact = Seen(name, q, v), distances(cell(name), q[None])[0]
    for p in np.flatnonzero(exact < STOP_DISTANCE - 1e-3).tolist():
        first = np.flatnonzero(seen.pair == p)[0]
        assert seen.lower[first] > 0.0
        if exact[p] > -0.03:
            opening = seen.lower[first] * np.linalg.norm(_gradient(name, q, p))
            assert opening <= APPROACH.recovery_speed * (1 + 1e-4)


def _least_free(name: str, q: Array, v: Array, duration: float, p: int) -> float:
    """Return B, the least free distance of a pair during a stop from (q, v) that is straight in joint space [m]."""
    way = np.linspace(0.0, 0.5 * duration, 33)[:, None] * v
    return float(distances(cell(name), q + way)[:, p].min()) - STOP_DISTANCE


@pytest.mark.parametrize("name", NAMES)
def test_velocities_that_satisfy_the_rows_use_up_free_distance_no_faster_than_the_gain_allows(name: str) -> None:
    """Velocities that break the rows use up free distance faster, so the rows are neither too lax nor too strict."""
    random, kept, broken = np.random.default_rng(5), 0, 0
    for seed in range(150):
        q, v = _state(name, seed, 0.4)
        seen = Seen(name, q, v)
        change = 10.0 * H * random.uniform(-1.0, 1.0, 14)
        for p in set(seen.pair.tolist()):
            if seen.distance[p] < STOP_DISTANCE:
                continue
            rows = np.flatnonzero(seen.pair == p)
            before = _least_free(name, q, v, seen.duration, p)
            if before < 0.0:
                continue
            after = _least_free(name, q + 0.5 * H * (2 * v + change), v + change, seen.duration, p)
            excess = (after - before) + APPROACH.gain * H * before
            meets = (seen.matrix[rows] @ (v + change) >= seen.lower[rows]).all()
            if meets:
                assert excess > -2e-5
                kept += 1
            else:
                broken += bool(excess < 2e-5)
                assert excess < 2e-4
    assert kept > 10
    assert broken > 10
