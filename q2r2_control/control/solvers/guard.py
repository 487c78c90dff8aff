"""Protect the controller's arrays from solvers other than DAQP, and a step from the failures of these solvers.

The safety filter clamps the answer to the same box that a solver gets. If a solver wrote into this box, it would change
the limits, and the certificate would use the changed limits. A solver therefore gets copies.

The user's own costs and rows may be of any size, and the sum of costs need not be convex. If numbers are very large, or
if the sum is not convex, some libraries print a line, and some loop for ever. The guard therefore gives no such problem
to a solver.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from q2r2_control.control.qp import QpProblem, QpSolution, Solver
from q2r2_control.errors import raised, shown

_REAL = "fiu"  # Kinds of dtype that are real numbers.
# A problem may be solved if no number in it is larger than the first value, and no diagonal entry of the Cholesky
# factor of its H is smaller than the second value. Without costs and rows of the user, these numbers are near 1.
_LARGEST, _FLATTEST = 1e12, 1e-8
_FAILED = QpSolution(None, 0.0)


class Guard:
    """Calls a ``solver``. Returns its solution in a new array, or a failed solve, and never raises an exception.

    Args:
        solver: An object with ``solve``, from any source.
        nv: Number of joints.
        clock: The clock that measures the time of a solve [s].

    Attributes:
        failure: The reason why the last answer was not a solution; None if it was a solution.
    """

    def __init__(self, solver: Solver, nv: int, clock: Callable[[], float] = time.perf_counter) -> None:
        self._solver, self._nv, self._clock = solver, nv, clock
        self.failure: str | None = None

    def solve(self, problem: QpProblem) -> QpSolution:
        """See :class:`Solver`.

        The answer must have an array ``v`` (nv,) of finite real numbers, and a finite ``solve_time`` of at least 0.
        An exception or any other answer counts as a failed solve. With ``v = None`` the solver itself reports a failed
        solve. The ``solve_time`` of the result is at least our measured time, so that no solver can hide a delay.
        """
        try:
            self.failure = _fault_of(problem)
            if self.failure is not None:
                return _FAILED
            begun = self._clock()
            answer: Any = self._solver.solve(_copy_of(problem))
            measured = self._clock() - begun
            v, solve_time = answer.v, answer.solve_time
            self.failure = "no solution" if v is None else self._fault(v, solve_time)
            if self.failure is None:
                return QpSolution(np.array(v, dtype=float), max(float(solve_time), measured))
        except (KeyboardInterrupt, SystemExit):  # A signal's handler raises these exceptions to end the program.
            raise
        except BaseException as error:  # Any other exception, such as a panic in Rust, counts as a failed solve.
            self.failure = raised(error)
        return _FAILED

    def _fault(self, v: Any, solve_time: Any) -> str | None:
        if not isinstance(v, np.ndarray) or v.dtype.kind not in _REAL or v.shape != (self._nv,):
            return f"v = {shown(v)}: allowed: an array of shape ({self._nv},), or None"
        if not np.isfinite(v).all():
            return f"v = {shown(v)}: allowed: finite numbers"
        if not isinstance(solve_time, float | int | np.floating) or not 0.0 <= float(solve_time) < math.inf:
            return f"solve_time = {shown(solve_time)}: allowed: seconds, 0 or more"
        return None


def _fault_of(problem: QpProblem) -> str | None:
    """Return why the ``problem`` must not be given to a solver; None if it may be given."""
    for part in (problem.H, problem.g, problem.rows, problem.rows_lower):
        if not np.abs(part).max(initial=0.0) <= _LARGEST:  # The comparison is written so that NaN is too large as well.
            return f"the problem has numbers that are not finite, or above {_LARGEST:g}"
    try:
        factor = np.linalg.cholesky(problem.H)
    except np.linalg.LinAlgError:
        return "the problem's cost is not convex"
    return "the problem's cost is too flat" if factor.diagonal().min() < _FLATTEST else None


def _copy_of(problem: QpProblem) -> QpProblem:
    return QpProblem(
        H=problem.H.copy(),
        g=problem.g.copy(),
        lower=problem.lower.copy(),
        upper=problem.upper.copy(),
        rows=problem.rows.copy(),
        rows_lower=problem.rows_lower.copy(),
        minimum=None if problem.minimum is None else problem.minimum.copy(),
        hard=problem.hard,
    )
