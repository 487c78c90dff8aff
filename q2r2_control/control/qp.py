"""The QP as data, and the solvers that take it. Building is pure and separate from solving.

    minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i,    rho_i = SOFTNESS a_i' H^-1 a_i,  a_i the i-th row
    subject to  lower <= v <= upper,    rows v + s >= rows_lower,    s >= 0

The box is never empty (joint_limits.py) and the rows are soft, so a solution always exists. Rows have unit norm, so
that a slack is a joint speed. H^-1 along a row is what the cost yields to it: a row alone gives way by the part
SOFTNESS of what it corrects, however strong the cost. This is DAQP's own notion of softness; other solvers are given
the same. Where the cost's own minimum keeps box and rows it is the solution, and no solver has to be asked.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import daqp
import numpy as np
import qpsolvers

from q2r2_control.errors import ConfigError
from q2r2_control.types import Array

SOFTNESS = 1e-5  # part of its correction by which a row gives way
_UNBOUNDED = 1e30


@dataclass(slots=True)  # not frozen: that would cost a microsecond a tick
class QpProblem:
    """One tick's problem; arrays are valid until the next tick."""

    H: Array  # (nv, nv), symmetric positive definite
    g: Array  # (nv,)
    lower: Array  # (nv,) [rad/s]
    upper: Array  # (nv,) [rad/s]
    rows: Array  # (m, nv), unit rows
    rows_lower: Array  # (m,) [rad/s]
    minimum: Array | None = None  # (nv,) of the cost alone, if that keeps box and rows and so is the solution [rad/s]

    def softness(self) -> Array:
        """rho (m,): how far each row gives way per unit of its multiplier."""
        return np.asarray(SOFTNESS * np.sum(self.rows * np.linalg.solve(self.H, self.rows.T).T, axis=1))


@dataclass(slots=True)
class QpSolution:
    """What a solver found."""

    v: Array | None  # (nv,) [rad/s]; None: no solution
    solve_time: float  # the solver's own measure, 0 where none was asked [s]


class Solver(Protocol):
    """Solves a :class:`QpProblem`; never raises for a numerical reason."""

    def solve(self, problem: QpProblem) -> QpSolution: ...


class SkipIfUnconstrained:
    """Asks a solver only where a bound holds the cost's own minimum back."""

    def __init__(self, solver: Solver) -> None:
        self.solver = solver

    def solve(self, problem: QpProblem) -> QpSolution:
        """See :class:`Solver`; takes no time of a solver where none is asked."""
        return self.solver.solve(problem) if problem.minimum is None else QpSolution(problem.minimum, 0.0)


class DaqpSolver:
    """DAQP (Arnstrom, Bemporad, Axehill, IEEE TAC 2022): dual active set, soft rows of its own."""

    _OPTIMAL = (1, 2)  # 2: optimal with a soft row violated

    def __init__(self, nv: int, time_limit: float | None) -> None:
        self._nv = nv
        self._time_limit = time_limit or 0.0  # 0: none
        self._upper = np.full(nv, _UNBOUNDED)
        self._lower = np.full(nv, -_UNBOUNDED)
        self._sense = np.zeros(nv, dtype=np.int32)

    def solve(self, problem: QpProblem) -> QpSolution:
        nv = self._nv
        m = nv + len(problem.rows_lower)
        if m > len(self._upper):
            self._upper = np.full(m, _UNBOUNDED)
            self._lower = np.empty(m)
            self._sense = np.full(m, 8, dtype=np.int32)  # soft
            self._sense[:nv] = 0
        self._upper[:nv] = problem.upper
        self._lower[:nv] = problem.lower
        if m > nv:
            self._lower[nv:m] = problem.rows_lower
        v, _, flag, info = daqp.solve(
            problem.H,
            problem.g,
            problem.rows,
            self._upper[:m],
            self._lower[:m],
            self._sense[:m],
            rho_soft=SOFTNESS,
            time_limit=self._time_limit,
        )
        return QpSolution(v if flag in self._OPTIMAL else None, info["setup_time"] + info["solve_time"])


class QpsolversSolver:
    """Any other solver through qpsolvers, with the slack as extra variables."""

    def __init__(self, name: str) -> None:
        self._name = name

    def solve(self, problem: QpProblem) -> QpSolution:
        nv, m = len(problem.g), len(problem.rows_lower)
        P = np.diag(np.concatenate([np.zeros(nv), 1.0 / problem.softness()]))
        P[:nv, :nv] = problem.H
        before = time.perf_counter()
        try:
            x = qpsolvers.solve_qp(
                P,
                np.concatenate([problem.g, np.zeros(m)]),
                G=-np.hstack([problem.rows, np.eye(m)]) if m else None,
                h=-problem.rows_lower if m else None,
                lb=np.concatenate([problem.lower, np.zeros(m)]),
                ub=np.concatenate([problem.upper, np.full(m, np.inf)]),
                solver=self._name,
            )
        except Exception:  # each solver behind qpsolvers has exceptions of its own
            x = None
        v = None if x is None else np.asarray(x[:nv], dtype=np.float64)
        # qpsolvers tells no time; this is the one place below the pipeline that reads a clock.
        return QpSolution(v, time.perf_counter() - before)


def make_solver(name: str, nv: int, time_limit: float | None) -> Solver:
    """Solver by its name in the YAML; ``time_limit`` [s] is given to solvers that take one.

    Raises :class:`ConfigError` for a solver that is not installed.
    """
    if name == "daqp":
        return SkipIfUnconstrained(DaqpSolver(nv, time_limit))
    available = sorted({"daqp", *qpsolvers.available_solvers})
    if name not in available:
        raise ConfigError(f"control.solver = {name!r}: not installed; allowed here: {', '.join(available)}")
    return SkipIfUnconstrained(QpsolversSolver(name))
