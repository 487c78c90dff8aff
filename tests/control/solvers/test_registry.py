"""Solvers are found by their names, in settings and in Python. A missing solver raises an error of one line."""

from __future__ import annotations

from typing import Any

import pytest
import qpsolvers

from q2r2_control import CartesianController, ConfigError
from q2r2_control.config.control import ControllerSettings
from tests.control.cells import cell

ROBOT = cell("dual_iiwa7").robot


def test_the_error_for_an_unknown_solver_names_the_installed_solvers_and_says_how_to_install_other_solvers() -> None:
    with pytest.raises(ConfigError) as caught:
        CartesianController(ROBOT, ControllerSettings(solver="osqb"))
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith("control.solver = 'osqb': installed: ")
    assert all(name in line for name in ("daqp", "osqp", *qpsolvers.available_solvers))
    assert line.endswith("pip install 'qpsolvers[open-source-solvers]'")


def test_a_known_solver_that_is_not_installed_is_named_with_the_command_that_installs_it() -> None:
    missing = next(name for name in ("gurobi", "mosek", "cvxopt") if name not in qpsolvers.available_solvers)
    with pytest.raises(ConfigError, match=rf"pip install 'qpsolvers\[{missing}\]'$"):
        CartesianController(ROBOT, solver=missing)


@pytest.mark.parametrize("name", ["daqp", "osqp"])
def test_an_option_that_a_solver_does_not_have_is_refused_when_the_controller_is_made(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"control\.solver_options = \{{'colour': 1\}}: {name} refuses: "):
        CartesianController(ROBOT, ControllerSettings(solver=name, solver_options={"colour": 1}))


def test_a_solver_name_in_python_replaces_the_name_in_the_settings() -> None:
    assert CartesianController(ROBOT, ControllerSettings(), solver="osqp").settings.solver == "osqp"


@pytest.mark.parametrize("solver", [object(), 3, ["osqp"]], ids=["object", "number", "list"])
def test_an_argument_that_is_neither_a_name_nor_a_solver_is_refused(solver: Any) -> None:
    with pytest.raises(ConfigError, match="allowed: a solver's name, a Solver, or None"):
        CartesianController(ROBOT, ControllerSettings(), solver=solver)


def test_options_apply_only_to_the_solver_of_the_settings() -> None:
    settings = ControllerSettings(solver="daqp", solver_options={"iter_limit": 500})
    assert settings.with_solver(None) is settings.with_solver("daqp") is settings
    other = settings.with_solver("osqp")
    assert (other.solver, other.solver_options) == ("osqp", {})
    CartesianController(ROBOT, settings, solver="osqp")
