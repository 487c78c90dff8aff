"""The solvers that are installed, and how exactly each one solves a QP of the controller."""

from __future__ import annotations

from functools import cache

import pytest
import qpsolvers

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.solvers.registry import OURS
from tests.control.cells import cell

ROBOT = cell("dual_iiwa7").robot
# DAQP first, with which the others are compared. Sorted, so that every process of a test run has the same order.
NAMES = (*OURS, *sorted(set(qpsolvers.available_solvers) - set(OURS)))

# By themselves these two stop at a residual, far from which the cost is flat where an arm is nearly stretched.
EXACTLY: dict[str, dict[str, float]] = {
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-9},
}
_BY_EQUATIONS = ("daqp", "quadprog")  # active-set methods, which are exact to rounding


def accuracy_of(name: str) -> float:
    """How near to the solution every joint's velocity is [rad/s], with the options of ``EXACTLY``."""
    return 1e-8 if name in _BY_EQUATIONS else 2e-3


def each_solver() -> list[pytest.ParameterSet]:
    """All names; those beyond the package's own are slow, and run with ``pytest tests/qp``."""
    return [pytest.param(name, marks=() if name in OURS else pytest.mark.slow) for name in NAMES]


@cache
def controller_with(name: str) -> CartesianController:
    """Two iiwa 7 with the solver of this name and all settings as they are by default. A reset starts it anew."""
    return CartesianController(ROBOT, ControllerSettings(), solver=name)
