"""The plant refuses cells whose limits it cannot keep."""

from __future__ import annotations

import pytest

from q2r2_control import ConfigError, Robot, load_config


def test_a_jerk_limit_that_the_mean_of_five_positions_cannot_keep_is_refused() -> None:
    pytest.importorskip("pylibfranka", reason="pip install -e plugins/q2r2_franka")
    from q2r2_franka.plant import FrankaPlant

    config = load_config("plugins/q2r2_franka/dual_fr3.yaml")
    robot = Robot.from_config(config)
    assert FrankaPlant(robot, config).averages
    stricter = config.model_copy(update={"control": config.control.model_copy(update={"jerk_limit": 1900.0})})
    with pytest.raises(ConfigError, match=r"control.jerk_limit = 1900.0: allowed with robots: 1920 rad/s\^3 or more"):
        FrankaPlant(robot, stricter)
