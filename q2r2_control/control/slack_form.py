"""The QP of a step in the form that other solvers take: one slack a row, as a ``qpsolvers.Problem``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from q2r2_control.control.qp import SOFTNESS, QpProblem

if TYPE_CHECKING:
    import qpsolvers

_LEAST_SOFTNESS = 1e-12


def with_slacks(problem: QpProblem) -> qpsolvers.Problem:
    """The QP of x = [v; s], with a slack s_i for each row a_i.

        minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i,    rho_i = SOFTNESS a_i' H^-1 a_i
        subject to  lower <= v <= upper,    rows v + s >= rows_lower,    s >= 0,    s_i = 0 for a hard row

    Args:
        problem: Of a step.

    Returns:
        The problem in arrays of its own, with P (nv + m, nv + m), q (nv + m,), G (m, nv + m), h (m,), lb and
        ub (nv + m,). v and s are in rad/s.
    """
    import qpsolvers  # which imports every solver that is installed

    nv, m = len(problem.g), len(problem.rows_lower)
    compliance = np.linalg.lstsq(problem.H, problem.rows.T, rcond=None)[0].T
    softness = SOFTNESS * np.maximum((problem.rows * compliance).sum(axis=1), _LEAST_SOFTNESS)
    P = np.zeros((nv + m, nv + m))
    P[:nv, :nv] = problem.H
    P[nv:, nv:] = np.diag(1.0 / softness)
    most = np.full(m, np.inf)
    most[m - problem.hard :] = 0.0
    return qpsolvers.Problem(
        P=P,
        q=np.append(problem.g, np.zeros(m)),
        G=np.hstack([-problem.rows, -np.eye(m)]) if m else None,
        h=-problem.rows_lower if m else None,
        lb=np.append(problem.lower, np.zeros(m)),
        ub=np.append(problem.upper, most),
    )
