"""Call DAQP directly. It is the default solver and the fastest one."""

from __future__ import annotations

from typing import Any

import daqp
import numpy as np

from q2r2_control.control.qp import SOFTNESS, QpProblem, QpSolution

_UNBOUNDED = 1e30
_HARD, _SOFT = 0, 8  # Flags of a hard and of a soft row in DAQP.


class DaqpSolver:
    """DAQP (Arnstrom, Bemporad, Axehill, IEEE TAC 2022), a dual active-set method with soft rows.

    DAQP starts cold at each tick. A warm start from the last multipliers would save 16 of 17 iterations in contact. It
    would save no time, because the set-up of the problem takes most of the time. Moreover, the solution would then
    depend on the past.

    Args:
        nv: Number of joints.
        time_limit: DAQP gives up after this time [s]; None if it never gives up.
        options: Settings of ``daqp.solve``, such as ``iter_limit``.
    """

    _OPTIMAL = (1, 2)  # The value 2 means optimal with a violated soft row.

    def __init__(self, nv: int, time_limit: float | None = None, **options: Any) -> None:
        self._nv = nv
        self._options = {"rho_soft": SOFTNESS, "time_limit": time_limit or 0.0} | options  # The value 0 means no limit.
        self._upper = np.full(nv, _UNBOUNDED)
        self._lower = np.full(nv, -_UNBOUNDED)
        self._sense = np.zeros(nv, dtype=np.int32)

    def solve(self, problem: QpProblem) -> QpSolution:
        """See :class:`Solver`. DAQP is called only if the minimum of the cost breaks the box or a row."""
        if problem.minimum is not None:
            return QpSolution(problem.minimum, 0.0)
        nv = self._nv
        m = nv + len(problem.rows_lower)
        if m > len(self._upper):
            self._upper = np.full(m, _UNBOUNDED)
            self._lower = np.empty(m)
            self._sense = np.full(m, _SOFT, dtype=np.int32)
            self._sense[:nv] = _HARD
        self._upper[:nv] = problem.upper
        self._lower[:nv] = problem.lower
        if m > nv:
            self._lower[nv:m] = problem.rows_lower
        if problem.hard:
            self._sense[m - problem.hard : m] = _HARD
        v, _, flag, info = daqp.solve(
            problem.H,
            problem.g,
            problem.rows,
            self._upper[:m],
            self._lower[:m],
            self._sense[:m],
            **self._options,
        )
        if problem.hard:
            self._sense[m - problem.hard : m] = _SOFT
        return QpSolution(v if flag in self._OPTIMAL else None, info["setup_time"] + info["solve_time"])
