"""The time over which commands are averaged follows from the jerk limit.

The averaged command can deviate from the path of the reference. Every pair therefore keeps a distance that is greater
by an allowance. No such deviation brings the pair closer by more than its allowance.
"""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import ConfigError
from q2r2_control.robot.command_average import average_allowance, average_window
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot

NV = 14


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


def test_the_averaging_window_is_the_time_that_the_acceleration_needs_from_one_limit_to_the_other(robot: Robot) -> None:
    assert average_window(robot, ControllerSettings()) == 0.0
    assert average_window(robot, ControllerSettings(jerk_limit=5000.0)) == pytest.approx(0.004)
    slower = ControllerSettings(jerk_limit=5000.0, acceleration_limit=5.0)
    assert average_window(robot, slower) == pytest.approx(0.002)


def test_the_joint_with_the_lowest_jerk_limit_decides_the_window(robot: Robot) -> None:
    jerk = (5000.0,) * 10 + (2500.0,) + (5000.0,) * 3
    assert average_window(robot, ControllerSettings(jerk_limit=jerk)) == pytest.approx(0.008)


@pytest.mark.parametrize(
    ("jerk", "why"),
    [
        ((5000.0,) * 3, r"control\.jerk_limit has 3 numbers: allowed: one, or 14, one for each joint: left_A1, "),
        (300.0, r"control\.jerk_limit = 300: allowed for left_A. with its acceleration limit: 400 rad/s\^3 or more"),
    ],
)
def test_the_error_about_a_jerk_limit_that_does_not_fit_the_robot_says_what_is_allowed(
    robot: Robot, jerk: object, why: str
) -> None:
    with pytest.raises(ConfigError, match=why):
        kept_distances(robot, ControllerSettings(jerk_limit=jerk))


def test_no_pair_comes_closer_by_more_than_the_allowance_if_every_joint_is_off_its_path(robot: Robot) -> None:
    settings = ControllerSettings(jerk_limit=1000.0)
    off = 0.25 * average_window(robot, settings) ** 2 * robot.capped_acceleration(10.0)
    allowance = average_allowance(robot, settings, robot.collision_model)
    random, largest = np.random.default_rng(3), np.zeros(len(allowance))
    for _ in range(60):
        q = random.uniform(robot.position_lower, robot.position_upper)
        moved = q + off * random.choice([-1.0, 1.0], NV)
        largest = np.maximum(largest, np.abs(robot.distance_values(moved) - robot.distance_values(q)))
    assert (largest <= allowance + 1e-9).all()
    assert float((largest / np.maximum(allowance, 1e-12)).max()) > 0.2, "the allowance is far too large"


def test_with_a_jerk_limit_the_kept_distance_of_every_pair_grows_by_its_allowance(robot: Robot) -> None:
    plain, limited = ControllerSettings(), ControllerSettings(jerk_limit=5000.0)
    more = kept_distances(robot, limited).values - kept_distances(robot, plain).values
    assert more == pytest.approx(average_allowance(robot, limited, robot.collision_model), abs=1e-12)
    assert 0.0 < more.max() < 0.0005
