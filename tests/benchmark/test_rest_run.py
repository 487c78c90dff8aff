"""The bench of rest: what it draws, and what it counts."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.benchmark.rest_run import DT, JOLT, KINDS, STARTED, count_jolts, draw_targets
from q2r2_control.config.cell import load_config
from q2r2_control.robot.robot import Robot


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_draws_the_same_targets_and_another_one_others(robot: Robot, kind: str) -> None:
    first, again, other = (draw_targets(robot, kind, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert all(first[arm] == again[arm] and first[arm] != other[arm] for arm in ("left", "right"))


def test_tools_are_asked_for_places_on_the_side_of_the_other_arm(robot: Robot) -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        targets = draw_targets(robot, "other side", random)
        assert targets["left"].translation[1] < 0.0 < targets["right"].translation[1]


def test_a_jolt_is_a_change_of_acceleration_after_the_start() -> None:
    n, late = round(2.0 * STARTED / DT), round(1.5 * STARTED / DT)
    v = np.zeros((n, 7))
    v[late:, 3] = 1.1 * JOLT * DT  # an acceleration of 1.1 JOLT in one tick, and its end in the next
    assert count_jolts(v, DT) == 2
    assert count_jolts(0.8 * v, DT) == 0
    assert count_jolts(np.roll(v, -late + 10, axis=0)[: n - late], DT) == 0, "at the start"
