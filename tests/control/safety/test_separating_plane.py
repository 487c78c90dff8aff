from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel
from q2r2_control.control.geometry.pair_distance import measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.safety.safety_data import QuadraticPiece, SafetyData
from q2r2_control.control.safety.separating_plane import stays_beyond
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, distances, kernel_model, random_posture, reused_data

H = 0.002


def _moved(q: Array, v: Array, v_next: Array, t: Array) -> Array:
    t = t[:, None]
    return np.asarray(q + v * t + (v_next - v) * t**2 / (2.0 * H))


def _prepared(name: str, q: Array, v: Array, v_next: Array) -> SafetyData:
    data = reused_data(name, q, v).safety
    step = data.rollout.step
    step.rate[:], step.change[:] = v, (v_next - v) / H
    step.travel[:] = np.abs(_moved(q, v, v_next, np.linspace(0.0, H, 50)) - q).max(axis=0)
    return data


def _proven(name: str, data: SafetyData, p: int, threshold: float) -> bool:
    return bool(_stays_beyond(kernel_model(name).safety.collision, data.collision, data.rollout.step, p, threshold))


@kernel
def _stays_beyond(model: CollisionModel, data: CollisionData, step: QuadraticPiece, p: int, threshold: float) -> bool:
    measure(model, data, p)
    return stays_beyond(model, data, p, step, H, step, 0.0, threshold)


@pytest.mark.parametrize("name", NAMES)
def test_a_proven_distance_holds_during_the_whole_step_and_is_often_close_to_the_least_distance(name: str) -> None:
    random, robot = np.random.default_rng(21), cell(name).robot
    proven = 0
    for _ in range(40):
        q = random_posture(robot, random)
        v = 0.3 * random.uniform(-1.0, 1.0, len(q))
        v_next = v + 0.02 * random.uniform(-1.0, 1.0, len(q))
        along = distances(cell(name), _moved(q, v, v_next, np.linspace(0.0, H, 20)))
        data = _prepared(name, q, v, v_next)
        for p in np.flatnonzero((along[0] > 1e-3) & (along[0] < 0.3)).tolist():
            least = float(along[:, p].min())
            assert not _proven(name, data, p, least + 1e-9)
            proven += _proven(name, data, p, least - 2e-5)
    assert proven > 100


@pytest.mark.parametrize("name", NAMES)
def test_a_pair_that_opens_from_exactly_its_threshold_is_proven_to_stay_beyond_the_threshold(name: str) -> None:
    """A bound from the first distance and the travel alone cannot prove this: the pair has no distance to spare."""
    random, robot = np.random.default_rng(22), cell(name).robot
    parted = 0
    for _ in range(40):
        q, step = random_posture(robot, random), 1e-6
        here = distances(cell(name), q[None])[0]
        gradient = (distances(cell(name), q + step * np.eye(len(q))) - here) / step
        # Some distances depend on no joint, such as the distance of an arm's first link from the table.
        movable = np.abs(gradient).max(axis=0) > 0.01
        for p in np.flatnonzero((here > 1e-3) & (here < 0.3) & movable)[:4].tolist():
            away = gradient[:, p] / np.abs(gradient[:, p]).max()
            if np.abs(_difference(name, q, away, p) - gradient[:, p] @ away) > 1e-3:
                continue  # The closest points jump here, so that there is no gradient.
            apart, closer = (
                _proven(name, _prepared(name, q, np.zeros(len(q)), sign * 0.02 * away), p, float(here[p]) - 1e-9)
                for sign in (1.0, -1.0)
            )
            parted += apart
            assert not closer
    assert parted > 40


def _difference(name: str, q: Array, direction: Array, p: int) -> float:
    small = 1e-6
    after = distances(cell(name), (q + small * direction)[None])[0, p]
    return float((after - distances(cell(name), q[None])[0, p]) / small)
