"""Cells for several tests. Loading a cell takes a tenth of a second, and so each cell is loaded only once."""

from __future__ import annotations

from typing import Any

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.compose import ComposedCell, compose
from q2r2_control.robot.robot import Robot
from tests.control.cells import pandas


def one_arm(**arm: Any) -> Config:
    """Return a cell of one arm, by default a bare iiwa 7 with all joints at zero."""
    return Config.model_validate({"name": "cell", "arms": {"left": {"model": "iiwa7", "home": [0.0] * 7} | arm}})


@pytest.fixture(scope="session", params=["dual_iiwa7", "dual_iiwa14"])
def dual_iiwa(request: pytest.FixtureRequest) -> Robot:
    return Robot.from_config(load_config(f"config/{request.param}.yaml"))


@pytest.fixture(scope="session")
def dual_iiwa7() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


@pytest.fixture(scope="session")
def dual_iiwa7_cell() -> ComposedCell:
    return compose(load_config("config/dual_iiwa7.yaml"))


@pytest.fixture(scope="session")
def dual_panda() -> Robot:
    return Robot.from_config(pandas())
