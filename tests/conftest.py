"""Whatever order tests run in, what they draw from Pinocchio's random numbers is the same."""

from __future__ import annotations

import pinocchio as pin
import pytest


@pytest.fixture(autouse=True)
def _seeded_pinocchio() -> None:
    """Seed ``pin.SE3.Random`` and the like, which share one generator."""
    pin.seed(1)
