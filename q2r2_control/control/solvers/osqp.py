"""Call OSQP (Stellato et al., Mathematical Programming Computation 2020) with a warm start from tick to tick.

OSQP is a first-order method, which is fast only if all directions of a problem have similar scales. With H = L L' and
w = L' v the quadratic part of the cost is w' w / 2. With rows a_i L^-T of unit norm, the slacks of all rows have the
same softness:

    minimise    1/2 w' w + (L^-1 g)' w + 1/2 sum_i t_i^2
    subject to  D lower <= D L^-T w <= D upper,    a_i L^-T w / n_i + sqrt(SOFTNESS) t_i >= lower_i / n_i

Here n_i = |L^-1 a_i|, and D scales the rows of the box to unit norm as well. A slack below 0 costs as much as a slack
above 0, so the problem does not need t >= 0. OSQP needs a fixed sparsity pattern. One problem with a dense pattern is
therefore set up for 16 rows, another problem for 32 rows, and so on. Unused rows have infinite bounds. Each problem is
set up at the first tick that needs it. At later ticks, OSQP starts from the last solution of the same problem.
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

_ROWS_STEP = 16  # Step between the numbers of rows for which OSQP is set up.
# adaptive_rho_interval counts iterations. If the interval depended on the clock instead, runs would not be repeatable.
_DEFAULTS: dict[str, Any] = {
    "eps_abs": 1e-5,
    "eps_rel": 1e-5,
    "max_iter": 10000,  # From a cold start, a problem with 60 contradictory rows needs half of this number.
    "check_termination": 10,
    "adaptive_rho_interval": 50,
    "scaling": 0,
    "polishing": False,
    "verbose": False,
}


class OsqpSolver:
    """OSQP with a fixed sparsity pattern.

    Args:
        nv: Number of joints.
        time_limit: OSQP gives up after this time [s]; None if it never gives up.
        options: Settings of ``osqp.OSQP.setup``. They replace settings in :data:`_DEFAULTS`.
    """

    def __init__(self, nv: int, time_limit: float | None = None, **options: Any) -> None:
        limit = {} if time_limit is None else {"time_limit": time_limit}
        self._nv, self._options = nv, _DEFAULTS | limit | options
        self._sized: dict[int, _SizedOsqp] = {}

    def solve(self, problem: QpProblem) -> QpSolution:
        """See :class:`Solver`. OSQP is called only if the minimum of the cost breaks the box or a row.

        Raises:
            numpy.linalg.LinAlgError: If H is not positive definite.
        """
        if problem.minimum is not None:
            return QpSolution(problem.minimum, 0.0)
        steps = max(math.ceil(len(problem.rows_lower) / _ROWS_STEP), 1)
        if steps not in self._sized:
            self._sized[steps] = _SizedOsqp(self._nv, steps * _ROWS_STEP, self._options)
        return self._sized[steps].solve(problem)


class _SizedOsqp:
    """OSQP for up to ``capacity`` rows."""

    def __init__(self, nv: int, capacity: int, options: dict[str, Any]) -> None:
        self._nv = nv
        # The pattern has all entries of the columns of w, also zeros, and then one entry in each column of t.
        pattern = scipy.sparse.csc_matrix(np.hstack([np.ones((nv + capacity, nv)), np.eye(nv + capacity)[:, nv:]]))
        self._entries = pattern.data.copy()
        # Both arrays below share their memory with ``_entries``.
        self._matrix = self._entries[: (nv + capacity) * nv].reshape((nv + capacity, nv), order="F")
        self._slacks = self._entries[self._matrix.size :]
        self._slacks[:] = pattern.data[self._matrix.size :] = math.sqrt(SOFTNESS)
        self._lower, self._upper = np.full(nv + capacity, -np.inf), np.full(nv + capacity, np.inf)
        self._cost = np.zeros(nv + capacity)
        self._solver = osqp.OSQP()
        identity = scipy.sparse.eye(nv + capacity, format="csc")
        self._solver.setup(identity, self._cost, pattern, self._lower, self._upper, **options)
        self._cold = np.zeros(nv + capacity)

    def solve(self, problem: QpProblem) -> QpSolution:
        """Solve a problem whose minimum of the cost breaks the box or a row; see :meth:`OsqpSolver.solve`."""
        inverse = _inverse_factor(problem.H)
        self._write(problem, inverse)
        answer = self._solver.solve(raise_error=False)
        time = answer.info.update_time + answer.info.solve_time
        if answer.info.status_val != osqp.SolverStatus.OSQP_SOLVED:
            # The next solve starts cold, because the last iterate may be far from any solution.
            self._solver.warm_start(x=self._cold, y=self._cold)
            return QpSolution(None, time)
        v: Array = answer.x[: self._nv] @ inverse
        return QpSolution(v, time)

    def _write(self, problem: QpProblem, inverse: Array) -> None:
        """Write the problem into OSQP, with rows of unit norm; ``inverse`` is L^-1."""
        nv, m = self._nv, len(problem.rows_lower)
        rows = np.concatenate([inverse.T, problem.rows @ inverse.T])
        norms = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        self._matrix[nv + m :] = 0.0
        self._matrix[: nv + m] = rows / norms[:, None]
        self._lower[nv + m :] = -np.inf
        self._lower[:nv] = problem.lower / norms[:nv]
        self._upper[:nv] = problem.upper / norms[:nv]
        self._lower[nv : nv + m] = problem.rows_lower / norms[nv:]
        self._cost[:nv] = inverse @ problem.g
        self._slacks[:] = math.sqrt(SOFTNESS)
        self._slacks[m - problem.hard : m] = 0.0  # A hard row has no slack.
        self._solver.update(q=self._cost, l=self._lower, u=self._upper, Ax=self._entries)


def _inverse_factor(H: Array) -> Array:
    """Return L^-1 of H = L L' (nv, nv). LAPACK is called directly: other routines start threads for a small matrix."""
    factor, failed = scipy.linalg.lapack.dpotrf(H, lower=True)
    if failed:
        raise np.linalg.LinAlgError("H is not positive definite")
    inverse: Array = scipy.linalg.lapack.dtrtri(factor, lower=True)[0]
    return inverse
