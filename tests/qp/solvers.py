"""The installed solvers, and the accuracy of each for a QP of the controller."""

from __future__ import annotations

from functools import cache

import pytest
import qpsolvers

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.solvers.registry import OURS
from tests.control.cells import cell

ROBOT = cell("dual_iiwa7").robot
# DAQP, with which the other solvers are compared, comes first. Names are sorted so that all test processes agree.
NAMES = (*OURS, *sorted(set(qpsolvers.available_solvers) - set(OURS)))

# By default, these two solvers stop when a residual is small. For a nearly stretched arm, the cost is nearly flat, so
# that a small residual does not make the solution accurate.
EXACTLY: dict[str, dict[str, float]] = {
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-9},
}
_BY_EQUATIONS = ("daqp", "quadprog")  # Active-set methods are exact except for rounding.


def accuracy_of(name: str) -> float:
    """Return the accuracy of every joint's velocity [rad/s], with the options of ``EXACTLY``."""
    return 1e-8 if name in _BY_EQUATIONS else 2e-3


def each_solver() -> list[pytest.ParameterSet]:
    """Return all names as parameters of a test. Tests with other solvers than DAQP and OSQP are marked as slow."""
    return [pytest.param(name, marks=() if name in OURS else pytest.mark.slow) for name in NAMES]


@cache
def controller_with(name: str) -> CartesianController:
    """Return a controller of two iiwa 7 with this solver and default settings. A reset starts it again."""
    return CartesianController(ROBOT, ControllerSettings(), solver=name)
