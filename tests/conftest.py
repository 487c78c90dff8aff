"""Tests draw the same random numbers in any order and on a machine of any load."""

from __future__ import annotations

import pinocchio as pin
import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def _seeded_pinocchio() -> None:
    """Seed ``pin.SE3.Random`` and the like, which share one generator."""
    pin.seed(1)
