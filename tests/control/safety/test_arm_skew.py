"""Pairs for which a distance is proven keep this distance, wherever on its path each of the two arms is."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from q2r2_control.control.safety.arm_skew import is_far, keeps_apart_at_any_time, write_way
from q2r2_control.control.safety.reference_history import look_back, remember, rest_always
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.control.safety.speed_bound import write_deviations
from q2r2_control.control.safety.stop_certificate import write_step
from q2r2_control.control.safety.stop_rollout import SHAPES, begin_rollout
from tests.control.cells import NAMES, cell, distances, kernel_model, random_posture, reused_data
from tests.control.safety.motions import ACCELERATION, H, motion_of

WINDOW, PAIRS = 0.03, 8  # Largest delay of one arm behind the other arm [s], and number of pairs of each motion.


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@pytest.mark.parametrize("name", NAMES)
def test_every_pair_keeps_the_distances_that_are_proven_for_it_wherever_each_arm_is_on_its_path(
    name: str, shape: int
) -> None:
    random, robot, model = np.random.default_rng(91), cell(name).robot, kernel_model(name).safety
    right, kept = robot.arms["right"].joints, model.min_distance.copy()
    bound_used: list[float] = []
    lost: dict[int, list[float]] = {1: [], 2: []}  # For each proof, true least distance minus proven distance [m].
    for number in range(12):
        # The arms have rested, or have moved at a constant velocity. Then they accelerate for one step.
        v = (number % 2) * 0.3 * random.uniform(-robot.velocity_limit, robot.velocity_limit)
        v_next = v + random.uniform(-1.0, 1.0, robot.model.nv) * ACCELERATION * H
        motion = motion_of(name, random_posture(robot, random), v, v_next, shape)
        data = reused_data(name, motion.q, v).safety
        data.candidate.q[:], data.candidate.v[:] = motion.q_next, v_next
        data.candidate.deceleration[:] = motion.deceleration
        data.history.window[1] = WINDOW
        past = [motion.q - (WINDOW - k * H) * v for k in range(round(WINDOW / H) + 1)]
        rest_always(data.history, past[0])
        for q in past[:-1]:
            remember(data.history, q, v, v, H)
        duration = begin_rollout(data)
        write_step(data, H)
        time = write_deviations(model, data, H, duration)
        look_back(model.collision, data.history, motion.q, v)
        write_way(model, data, H, duration)
        path = np.concatenate([past[::5], motion.step()[::7], motion.stop(9)])
        both = np.repeat(path, len(path), axis=0)
        both[:, right] = np.tile(path[:, right], (len(path), 1))
        pairs = random.choice(np.flatnonzero(model.of_two_arms == 1), PAIRS, replace=False)
        now, nearest = distances(cell(name), motion.q[None], pairs=pairs)[0], distances(cell(name), both, pairs=pairs)
        for p, distance, least in zip(pairs.tolist(), now, nearest.min(axis=0), strict=True):
            data.distance[p] = distance
            proven = _largest(partial(_counts_as_far, model, data, p, time), distance)
            model.min_distance[p] = kept[p]
            assert least >= proven - 1e-8
            bound_used.append((distance - least) / (distance - proven))
            for proof, other in ((1, 2), (2, 1)):  # Proof 2 uses four times as many instants as proof 1.
                bend = data.history.bend[other].copy()
                data.history.bend[other] = np.inf  # With an infinite bend, the other proof proves nothing.
                proven = _largest(partial(keeps_apart_at_any_time, model, data, p, duration), distance)
                data.history.bend[other] = bend
                assert least >= proven - 1e-8
                lost[proof].append(least - proven)
    assert max(bound_used) > 0.2, "a bound that nothing comes near would examine every pair more closely"
    assert np.median(lost[1]) < 2e-4, "the plane proves nearly the true distance"
    assert np.median(lost[2]) < 5e-5, "with more instants even more of it"


def _counts_as_far(model: SafetyModel, data: SafetyData, p: int, time: float, threshold: float) -> bool:
    model.min_distance[p] = threshold
    return bool(is_far(model, data, p, time))


def _largest(holds: Callable[[float], bool], distance: float) -> float:
    """Return the greatest threshold [m] for which ``holds`` is True. The result is exact to 1 nm.

    Only thresholds that differ from ``distance`` [m] by at most 1 m are tried.
    """
    low, high = distance - 1.0, distance + 1.0
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
