"""Call any solver of the package qpsolvers, which has about twenty solvers, each with a name.

Such a solver has no soft rows. Every row therefore gets a slack of its own, and the variables are x = [v; s],

    minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i,    rho_i = SOFTNESS a_i' H^-1 a_i
    subject to  lower <= v <= upper,    s >= 0,    rows v + s >= rows_lower,    s_i = 0 for a hard row

Source: https://github.com/qpsolvers/qpsolvers, whose form is P, q, G x <= h, lb <= x <= ub.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import qpsolvers
import scipy.sparse

from q2r2_control.control.qp import QpProblem, QpSolution, row_softness

# Distance of the bounds of a variable from the value to which an equation fixes it [rad/s]. These bounds are not
# needed, but some solvers need finite numbers.
_WIDE = 1.0


def slack_problem(problem: QpProblem, sparse: bool = False, scaled: bool = False) -> qpsolvers.Problem:
    """Return the problem with a slack for each row.

    Args:
        problem: The problem, with nv joints and m rows.
        sparse: True for matrices of the type ``scipy.sparse.csc_matrix``, which some solvers need.
        scaled: True if the variables are the scaled slacks s_i / sqrt(rho_i), which all have the same cost. Without
            this scaling, quadprog finds some problems infeasible. Other solvers stop at a residual, and are less exact
            with this scaling.

    Returns:
        A ``qpsolvers.Problem`` in x = [v; s], (nv + m,) [rad/s], which shares no memory with ``problem``.
    """
    nv, m = len(problem.g), len(problem.rows_lower)
    P = np.zeros((nv + m, nv + m))
    P[:nv, :nv] = problem.H
    softness = row_softness(problem.H, problem.rows)
    P[range(nv, nv + m), range(nv, nv + m)] = 1.0 if scaled else 1.0 / softness
    unit = np.sqrt(softness) if scaled else np.ones(m)
    G = np.hstack([-problem.rows, -np.diag(unit)]) if m else None
    most = np.full(m, np.inf)
    most[m - problem.hard :] = 0.0
    return qpsolvers.Problem(
        P=scipy.sparse.csc_matrix(P) if sparse else P,
        q=np.concatenate([problem.g, np.zeros(m)]),
        G=scipy.sparse.csc_matrix(G) if sparse and m else G,
        h=-problem.rows_lower if m else None,
        lb=np.concatenate([problem.lower, np.zeros(m)]),
        ub=np.concatenate([problem.upper, most]),
    )


# Without these options, the solvers that are named here cannot be used in a control loop.
_DEFAULTS: dict[str, dict[str, Any]] = {
    # Without a limit, the active set of HiGHS may cycle for ever.
    "highs": {"output_flag": False, "qp_iteration_limit": 1000},
    "scs": {"max_iters": 10000},  # The default is ten times as many. A solve then takes a second.
}


class QpSolversSolver:
    """A solver of qpsolvers by its name.

    Args:
        name: One of ``qpsolvers.available_solvers``.
        options: Keyword arguments of that solver, see qpsolvers' documentation. They replace options in
            :data:`_DEFAULTS`.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._name, self._options = name, _DEFAULTS.get(name, {}) | options
        self._sparse = name not in qpsolvers.dense_solvers
        # The wrappers of qpsolvers warn if a problem is not solved. These warnings are ignored, because the report of
        # the step already says so.
        warnings.filterwarnings("ignore", module=r"qpsolvers\.solvers\.")

    def solve(self, problem: QpProblem) -> QpSolution:
        """See :class:`Solver`. The solver is called only if the minimum of the cost breaks the box or a row.

        Exceptions that qpsolvers or its solver raises are passed on.
        """
        if problem.minimum is not None:
            return QpSolution(problem.minimum, 0.0)
        made = slack_problem(problem, self._sparse, scaled=self._name == "quadprog")
        if made.h is not None:
            # Some solvers print a warning if a bound is so large that they take it as infinite. Every velocity in the
            # box satisfies a row with such a bound. The bound is therefore reduced to just beyond what the box allows.
            fastest = np.maximum(np.abs(problem.lower), np.abs(problem.upper))
            made.h = np.minimum(made.h, np.abs(problem.rows) @ fastest + 1.0)
        _state_equations(made, self._sparse)
        solution = qpsolvers.solve_problem(made, self._name, **self._options)
        time = (solution.build_time or 0.0) + (solution.solve_time or 0.0)
        if not solution.found or solution.x is None:
            return QpSolution(None, time)
        return QpSolution(solution.x[: len(problem.g)], time)


def _state_equations(problem: qpsolvers.Problem, sparse: bool) -> None:
    """Turn each pair of equal bounds into an equation, because quadprog finds no solution with such bounds."""
    lower, upper = np.asarray(problem.lb), np.asarray(problem.ub)
    fixed = lower == upper
    if not fixed.any():
        return
    A = np.eye(len(lower))[fixed]
    problem.A, problem.b = scipy.sparse.csc_matrix(A) if sparse else A, lower[fixed]
    problem.lb, problem.ub = np.where(fixed, lower - _WIDE, lower), np.where(fixed, upper + _WIDE, upper)
