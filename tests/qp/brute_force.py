"""Find the solution of a small QP without a solver, by trying every set of active bounds and rows.

With the best slacks, s_i = max(0, lower_i - a_i v), the cost is

    f(v) = 1/2 v' H v + g' v + 1/2 sum_i max(0, lower_i - a_i v)^2 / rho_i.

At the solution each joint is at its lower bound, at its upper bound or between them. Each row is satisfied or
violated. For each of these combinations f is a quadratic function, whose minimum is found by one linear system. Of all
these minima that satisfy the box and the hard rows, the one with the least cost is the solution, since f is strictly
convex.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from q2r2_control.control.qp import QpProblem, row_softness
from q2r2_control.types import Array

_ROUNDING = 1e-9


def cost_of(problem: QpProblem, v: Array) -> float:
    """Return the cost f, which the module's docstring defines, at velocities ``v`` (nv,) [rad/s].

    Hard rows are not part of this cost.
    """
    soft = len(problem.rows_lower) - problem.hard
    slack = np.maximum(problem.rows_lower - problem.rows @ v, 0.0)[:soft]
    softness = row_softness(problem.H, problem.rows)[:soft]
    return float(0.5 * v @ problem.H @ v + problem.g @ v + 0.5 * np.sum(slack**2 / softness))


def is_feasible(problem: QpProblem, v: Array, tolerance: float = _ROUNDING) -> bool:
    """Return whether ``v`` (nv,) [rad/s] is within the box and satisfies the hard rows, to a ``tolerance`` [rad/s]."""
    soft = len(problem.rows_lower) - problem.hard
    outside = np.maximum(problem.lower - v, v - problem.upper).max()
    lacking = (problem.rows_lower - problem.rows @ v)[soft:].max(initial=0.0)
    return bool(max(outside, lacking) <= tolerance)


def solve_by_brute_force(problem: QpProblem) -> Array:
    """Return the solution (nv,) [rad/s] of a problem that has one. The time grows as 3^nv 2^m."""
    best, least = None, np.inf
    for sides in product((-1, 0, 1), repeat=len(problem.g)):
        for active in product((False, True), repeat=len(problem.rows_lower)):
            v = _least_point(problem, np.array(sides), np.array(active, dtype=bool))
            if v is not None and is_feasible(problem, v) and (cost := cost_of(problem, v)) < least:
                best, least = v, cost
    assert best is not None
    return best


def _least_point(problem: QpProblem, sides: npt.NDArray[np.int64], active: npt.NDArray[np.bool_]) -> Array | None:
    """Return the minimum (nv,) [rad/s] of f for one combination; None if it does not exist.

    ``sides`` (nv,) is -1 for a joint at its lower bound, 1 at its upper bound, and 0 between them. Rows with ``active``
    (m,) are violated if they are soft, and are met exactly if they are hard.
    """
    soft = np.arange(len(active)) < len(active) - problem.hard
    giving, met = problem.rows[active & soft], problem.rows[active & ~soft]
    stiffness = 1.0 / row_softness(problem.H, problem.rows)[active & soft]
    H = problem.H + giving.T * stiffness @ giving
    g = problem.g - giving.T * stiffness @ problem.rows_lower[active & soft]
    fixed, free = sides != 0, sides == 0
    v = np.where(sides < 0, problem.lower, problem.upper) * fixed
    k = len(met)
    system = np.block([[H[np.ix_(free, free)], met[:, free].T], [met[:, free], np.zeros((k, k))]])
    right = np.concatenate([-(g + H @ v)[free], problem.rows_lower[active & ~soft] - met @ v])
    if not len(right):
        return v
    try:
        v[free] = np.linalg.solve(system, right)[: free.sum()]
    except np.linalg.LinAlgError:  # For example, there are more hard rows than free joints.
        return None
    return v
