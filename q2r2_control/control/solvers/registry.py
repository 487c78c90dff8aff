"""Find solvers by name."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.qp import QpProblem, Solver
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.control.solvers.guard import Guard
from q2r2_control.errors import ConfigError, shown

DAQP, OSQP = OURS = ("daqp", "osqp")


def make_solver(
    name: str, nv: int, time_limit: float | None = None, options: Mapping[str, Any] | None = None
) -> Solver:
    """Return the solver called ``name``.

    Args:
        name: The name. The solvers ``daqp`` and ``osqp`` are called directly. The solvers in
            ``qpsolvers.available_solvers`` are called through qpsolvers.
        nv: Number of joints.
        time_limit: DAQP and OSQP give up after this time [s]; None if they never give up.
        options: Keyword arguments of the solver.

    Returns:
        DAQP itself, or any other solver behind a :class:`Guard`.

    Raises:
        ConfigError: If there is no such solver, if it is not installed, or if it does not take the ``options``.
    """
    given = dict(options or {})
    check_installed(name)
    try:
        with printing_to_stderr():
            solver = _made(name, nv, time_limit, given)
            # A small problem is solved here, so that an unknown option raises an exception now and not during motion.
            solver.solve(_smallest_problem(nv))
    except Exception as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"control.solver_options = {shown(given)}: {name} refuses: {reason:.120}") from error
    return solver if name == DAQP else Guard(solver, nv)


def solver_of(settings: ControllerSettings, nv: int) -> Solver:
    """Return the solver that ``settings`` name; see :func:`make_solver`."""
    return make_solver(settings.solver, nv, settings.solve_time_limit, settings.solver_options)


def _made(name: str, nv: int, time_limit: float | None, options: dict[str, Any]) -> Solver:
    if name == DAQP:
        return DaqpSolver(nv, time_limit, **options)
    if name == OSQP:
        from q2r2_control.control.solvers.osqp import OsqpSolver

        return OsqpSolver(nv, time_limit, **options)
    # The import is local, because qpsolvers loads every installed solver, which takes a second.
    from q2r2_control.control.solvers.qpsolvers import QpSolversSolver

    return QpSolversSolver(name, **options)


@contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Send all output, also the output of compiled libraries, to stderr, because a command may print JSON on stdout."""
    try:
        sys.stdout.flush()
        stdout = os.dup(1)
    except (OSError, ValueError, AttributeError):  # The process has no stdout.
        yield
        return
    try:
        os.dup2(2, 1)
        yield
    finally:
        os.dup2(stdout, 1)
        os.close(stdout)


def check_installed(name: str) -> None:
    """Raise :class:`ConfigError` unless a solver called ``name`` is installed. It lists the installed solvers."""
    if name in OURS:
        return
    import qpsolvers  # The import is local for the same reason as in _made.

    if name not in qpsolvers.available_solvers:
        installed = ", ".join(sorted({*OURS, *qpsolvers.available_solvers}))
        extra = name if hasattr(qpsolvers, f"{name}_solve_qp") else "open-source-solvers"
        raise ConfigError(
            f"control.solver = {shown(name)}: installed: {installed}; the rest: pip install 'qpsolvers[{extra}]'"
        )


def _smallest_problem(nv: int) -> QpProblem:
    """Return a problem whose solution is not the minimum of the cost, because a row and the box are active."""
    row = np.zeros((1, nv))
    row[0, 0] = 1.0
    one = np.ones(nv)
    return QpProblem(np.eye(nv), -2.0 * one, -one, one, row, 0.5 * np.ones(1))
