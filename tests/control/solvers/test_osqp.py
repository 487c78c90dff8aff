"""OSQP is set up once. For successive problems with few or many rows, it finds the same solutions as DAQP."""

from __future__ import annotations

import numpy as np

from q2r2_control.control.qp import QpProblem
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.control.solvers.osqp import OsqpSolver

NV = 14


def _problem(random: np.random.Generator, rows: int) -> QpProblem:
    J = random.normal(size=(12, NV))
    matrix = random.normal(size=(rows, NV))
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True)
    middle, width = random.normal(size=NV) * 0.3, random.uniform(0.02, 1.0, NV)
    lower = random.uniform(-1.0, 0.2, rows)
    return QpProblem(J.T @ J + 0.1 * np.eye(NV), random.normal(size=NV), middle - width, middle + width, matrix, lower)


def test_osqp_finds_the_solution_of_daqp_for_any_number_of_rows() -> None:
    random, osqp, daqp = np.random.default_rng(3), OsqpSolver(NV), DaqpSolver(NV)
    for rows in (0, 5, 0, 17, 3, 60, 1):
        problem = _problem(random, rows)
        found, expected = osqp.solve(problem).v, daqp.solve(problem).v
        assert found is not None
        assert expected is not None
        np.testing.assert_allclose(found, expected, atol=2e-3)
