"""OSQP (Stellato et al., Mathematical Programming Computation 2020), set up once and warm-started from tick to tick.

OSQP is a first-order method, which needs a problem of even scale. With H = L L' and w = L' v the cost is that of
a unit ball, and with rows a_i L^-T of unit norm the slack of each has one and the same softness:

    minimise    1/2 w' w + (L^-1 g)' w + 1/2 sum_i t_i^2
    subject to  D lower <= D L^-T w <= D upper,    a_i L^-T w / n_i + sqrt(SOFTNESS) t_i >= lower_i / n_i

with n_i = |L^-1 a_i|, and D, which makes the rows of the box unit rows as well. A slack that is below 0 costs as much
as one above, so t >= 0 need not be said. The pattern is dense and fixed for a number of rows, of which unused ones
bound nothing. That number doubles when a tick has more rows: only then OSQP is set up anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse

from q2r2_control.control.qp import SOFTNESS, QpProblem, QpSolution
from q2r2_control.types import Array

_FEWEST_ROWS = 16
# adaptive_rho_interval counts iterations: by the clock, as it may be, a run would not be repeatable.
_DEFAULTS: dict[str, Any] = {
    "eps_abs": 1e-5,
    "eps_rel": 1e-5,
    "max_iter": 10000,  # 60 rows that contradict each other take half of it from a cold start
    "check_termination": 10,
    "adaptive_rho_interval": 50,
    "scaling": 0,
    "polishing": False,
    "verbose": False,
}


class OsqpSolver:
    """OSQP with a fixed sparsity pattern.

    Args:
        nv: number of joints.
        time_limit: OSQP gives up after this time [s]; None: never.
        options: settings of ``osqp.OSQP.setup``, in place of :data:`_DEFAULTS`.
    """

    def __init__(self, nv: int, time_limit: float | None = None, **options: Any) -> None:
        limit = {} if time_limit is None else {"time_limit": time_limit}
        self._nv, self._options = nv, _DEFAULTS | limit | options
        self._capacity = 0
        self._set_up(_FEWEST_ROWS)

    def _set_up(self, capacity: int) -> None:
        """Make room for ``capacity`` rows; the next solve starts cold."""
        nv, self._capacity = self._nv, capacity
        self._matrix = np.zeros((nv + capacity, nv))
        # All entries of the columns of w, also zeros, then one entry in each column of t.
        pattern = scipy.sparse.csc_matrix(np.hstack([np.ones_like(self._matrix), np.eye(nv + capacity)[:, nv:]]))
        pattern.data[self._matrix.size :] = math.sqrt(SOFTNESS)
        self._entries = pattern.data.copy()
        self._lower, self._upper = np.full(nv + capacity, -np.inf), np.full(nv + capacity, np.inf)
        self._cost = np.zeros(nv + capacity)
        self._solver = osqp.OSQP()
        identity = scipy.sparse.eye(nv + capacity, format="csc")
        self._solver.setup(identity, self._cost, pattern, self._lower, self._upper, **self._options)
        self._x, self._y = np.zeros(nv + capacity), np.zeros(nv + capacity)

    def solve(self, problem: QpProblem) -> QpSolution:
        """See :class:`Solver`; OSQP is asked only where a bound holds the cost's own minimum back.

        Raises ``numpy.linalg.LinAlgError`` where H is not positive definite.
        """
        if problem.minimum is not None:
            return QpSolution(problem.minimum, 0.0)
        nv, m = self._nv, len(problem.rows_lower)
        if m > self._capacity:
            self._set_up(2 ** math.ceil(math.log2(m)))
        factor: Array = np.linalg.cholesky(problem.H).astype(float, copy=False)
        self._write(problem, factor, m)
        answer = self._solver.solve(raise_error=False)
        time = answer.info.update_time + answer.info.solve_time
        if answer.info.status_val != osqp.SolverStatus.OSQP_SOLVED:
            self._solver.warm_start(x=self._x, y=self._y)  # where it is may be anywhere
            return QpSolution(None, time)
        v: Array = scipy.linalg.solve_triangular(factor, answer.x[:nv], trans=1, lower=True, check_finite=False)
        return QpSolution(v, time)

    def _write(self, problem: QpProblem, factor: Array, m: int) -> None:
        """Put the problem into OSQP, with unit rows."""
        nv = self._nv
        bounds = np.vstack([np.eye(nv), problem.rows])
        rows = scipy.linalg.solve_triangular(factor, bounds.T, lower=True, check_finite=False).T
        norms = np.sqrt(np.sum(rows**2, axis=1))
        self._matrix[nv + m :] = 0.0
        self._matrix[: nv + m] = rows / norms[:, None]
        self._lower[nv + m :] = -np.inf
        self._lower[:nv] = problem.lower / norms[:nv]
        self._upper[:nv] = problem.upper / norms[:nv]
        self._lower[nv : nv + m] = problem.rows_lower / norms[nv:]
        self._cost[:nv] = scipy.linalg.solve_triangular(factor, problem.g, lower=True, check_finite=False)
        self._entries[: self._matrix.size] = self._matrix.T.ravel()
        slacks = self._entries[self._matrix.size :]
        slacks[:] = math.sqrt(SOFTNESS)
        slacks[m - problem.hard : m] = 0.0  # a hard row has none
        self._solver.update(q=self._cost, l=self._lower, u=self._upper, Ax=self._entries)
