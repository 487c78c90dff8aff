"""The cell whose runs are viewed."""

from __future__ import annotations

import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.robot.robot import Robot


@pytest.fixture(scope="session")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))
