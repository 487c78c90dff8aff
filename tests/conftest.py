"""Tests get the same random numbers in any order and under any load, and use one robot of the shipped cell."""

from __future__ import annotations

import gc
from functools import wraps
from typing import TYPE_CHECKING

import pinocchio as pin
import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from q2r2_control import Robot

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def pytest_collection_finish() -> None:
    """Freeze imported objects. Otherwise, each run of a pipeline would spend 0.2 s on the collection of garbage.

    Each run asks for the number of frozen objects. Python would count them each time, for 20 ms or longer. Therefore a
    function that returns the first count replaces Python's own function. Its attribute ``__wrapped__`` is the function
    that it replaces.
    """
    gc.collect()
    gc.freeze()
    frozen, count = gc.get_freeze_count(), gc.get_freeze_count

    @wraps(count)
    def kept_count() -> int:
        return frozen

    gc.get_freeze_count = kept_count


@pytest.fixture(autouse=True)
def _seeded_pinocchio() -> None:
    """Seed ``pin.SE3.Random`` and similar functions, which share one generator."""
    pin.seed(1)


@pytest.fixture(scope="session")
def robot() -> Robot:
    """Return two iiwa 7 as in the shipped cell. No test changes this robot."""
    from q2r2_control import Robot  # The import is here because some tests check that nothing heavy is imported.
    from q2r2_control.config.cell_file import load_config

    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))
