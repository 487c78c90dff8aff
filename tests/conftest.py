"""Whatever order tests run in and however busy the machine is, what they draw at random is the same."""

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
