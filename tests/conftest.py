"""Tests draw the same random numbers in any order and on a machine of any load, and share the shipped robot."""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING

import pinocchio as pin
import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from q2r2_control import Robot

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def pytest_collection_finish() -> None:
    """Freeze what was imported: each run of a pipeline would otherwise collect garbage for a fifth of a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _seeded_pinocchio() -> None:
    """Seed ``pin.SE3.Random`` and the like, which share one generator."""
    pin.seed(1)


@pytest.fixture(scope="session")
def robot() -> Robot:
    """Two iiwa 7, as the shipped cell has them; no test changes it."""
    from q2r2_control import Robot  # here: what imports nothing heavy is tested as well
    from q2r2_control.config.cell import load_config

    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))
