"""How fast a target may go: never faster than the limit, no farther behind the hand than the leash, and no jump."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import SpeedLimitSettings
from q2r2_control.quaternions import floats_of
from q2r2_control.teleop.speed_limit import SpeedLimit
from tests.teleop.hands import TICK, engaged, pose, waving


def test_a_target_goes_no_faster_than_its_limit_and_comes_after_a_hand_that_rests() -> None:
    driver = engaged(speed_limit={"left": {"linear": 0.1, "angular": 0.15}})
    history = driver.run(0.5, waving(driver, speed=0.2))
    ahead = dict(driver.hands)
    history += driver.run(2.0)
    way = {"left": 0.1, "right": 1.0}
    turn = {"left": 0.15, "right": 1.0}
    for before, after in pairwise(history):
        for arm in way:
            a, b = before[arm].pose, after[arm].pose
            assert a is not None
            assert b is not None
            assert np.linalg.norm(b.translation - a.translation) < way[arm] * TICK + 1e-9
            assert np.linalg.norm(pin.log3(a.rotation.T @ b.rotation)) < turn[arm] * TICK + 1e-9
    assert driver.hands == ahead
    for arm in way:
        moved = driver.targets[arm].pose.translation - driver.tools[arm].translation  # type: ignore[union-attr]
        np.testing.assert_allclose(moved, (0.0, 0.1, 0.0), atol=2e-3)


def test_what_a_hand_gets_ahead_is_no_more_than_the_leash_is_long() -> None:
    driver = engaged(speed_limit={"left": {"linear": 0.05}})
    move = waving(driver, speed=0.3)
    for tick in range(1000):
        driver.hands |= move(TICK * tick)
        driver.commanded = {arm: driver.targets[arm].pose for arm in driver.targets}
        driver.tick()
    still = driver.targets["left"].pose.translation.copy()  # type: ignore[union-attr]
    for _ in range(4000):
        driver.commanded = {arm: driver.targets[arm].pose for arm in driver.targets}
        driver.tick()
    came_after = driver.targets["left"].pose.translation - still  # type: ignore[union-attr]
    assert 0.08 < np.linalg.norm(came_after) < 0.1 + 0.005  # and what the filter swings back when the hand stops


def test_of_two_limits_the_stricter_one_counts_and_without_one_a_target_is_left_alone() -> None:
    both = SpeedLimit([SpeedLimitSettings(linear=0.2), None, SpeedLimitSettings(linear=0.1)])
    free = SpeedLimit([None])
    for limit, expected in ((both, 0.001), (free, 0.5)):
        limit.limit(floats_of(pose()), 1.0)
        (x, _, _), _ = limit.limit(floats_of(pose(0.5)), 1.01)
        assert x == pytest.approx(expected)
