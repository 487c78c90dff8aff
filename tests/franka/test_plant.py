"""The plant refuses cells whose limits it cannot keep."""

from __future__ import annotations

import numpy as np
import pytest
from q2r2_franka import limits

from q2r2_control import ConfigError, Robot, load_config


def test_a_jerk_limit_is_refused_if_averaged_commands_would_exceed_it_or_would_be_too_far_from_the_path() -> None:
    pytest.importorskip("pylibfranka", reason="pip install -e plugins/q2r2_franka")
    from q2r2_franka.plant import FrankaPlant

    config = load_config("plugins/q2r2_franka/dual_fr3.yaml")
    robot = Robot.from_config(config)
    assert FrankaPlant(robot, config).averages
    for limit in (1199.0, 3000.0):
        other = config.model_copy(update={"control": config.control.model_copy(update={"jerk_limit": limit})})
        with pytest.raises(ConfigError, match=rf"control.jerk_limit = {limit}: allowed with robots: 1200 to 2962 rad"):
            FrankaPlant(robot, other)


def test_arms_move_at_a_tenth_of_their_speed_unless_all_robots_are_simulated_on_this_computer() -> None:
    pytest.importorskip("pylibfranka", reason="pip install -e plugins/q2r2_franka")
    from q2r2_franka.plant import FrankaPlant

    config = load_config("plugins/q2r2_franka/dual_fr3.yaml")
    assert FrankaPlant.drives_real_arms(config)
    for right, is_real in (("127.0.0.3", False), ("localhost", False), ("robot.lab", True), ("172.16.1.2", True)):
        robots = {"left": {"address": "127.0.0.2"}, "right": {"address": right}}
        cell = config.model_copy(update={"plant_settings": {"franka": robots}})
        assert FrankaPlant.drives_real_arms(cell) is is_real, right


def test_a_joint_that_brakes_before_its_position_limit_is_slower_than_an_fr3_allows_there() -> None:
    config = load_config("plugins/q2r2_franka/dual_fr3.yaml")
    robot = Robot.from_config(config)
    joints = robot.arms["left"].joints
    deceleration = robot.capped_acceleration(config.control.acceleration_limit)[joints]
    margin, fastest = config.control.position_margin, config.control.velocity_scale * limits.VELOCITY
    for distance in np.arange(margin, 2.0, 1e-3):
        braking = np.minimum(np.sqrt(2.0 * deceleration * (distance - margin)), fastest)
        _, allowed = limits.velocity_limits(limits.UPPER - distance)
        assert (braking <= allowed - 0.18).all()
