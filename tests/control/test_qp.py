from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import qpsolvers

from q2r2_control.control.qp import (
    DaqpSolver,
    QpProblem,
    QpsolversSolver,
    Solver,
    make_solver,
)
from q2r2_control.errors import ConfigError

# qpsolvers tells of sparse conversions and of OSQP's coarse tolerance; neither is what these tests are about.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
NV = 14
ROUTES: dict[str, Callable[[], Solver]] = {
    "daqp": lambda: DaqpSolver(NV, None),
    "osqp through qpsolvers": lambda: QpsolversSolver("osqp"),
    "daqp through qpsolvers": lambda: QpsolversSolver("daqp"),
}


def _problem(random: np.random.Generator, rows: int, conflicting: bool = False) -> QpProblem:
    J = random.normal(size=(12, NV))
    middle, width = random.normal(size=NV) * 0.3, random.uniform(0.02, 1.0, NV)
    matrix = random.normal(size=(rows, NV))
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True)
    lower = random.uniform(-1.0, 0.2, rows)
    if conflicting:
        matrix, lower = np.vstack([matrix, -matrix]), np.concatenate([lower, 0.3 - lower])
    return QpProblem(J.T @ J + 1e-3 * np.eye(NV), random.normal(size=NV), middle - width, middle + width, matrix, lower)


def _violation(problem: QpProblem, v: np.ndarray) -> float:
    """Largest violation of a row [rad/s]."""
    return float(np.max(problem.rows_lower - problem.rows @ v))


def _unmet_conditions(problem: QpProblem, v: np.ndarray) -> float:
    """How far ``v`` is from the minimum: the step that the cost's gradient, scaled by its curvature, asks for.

    Without slack variables the soft problem is a convex, once differentiable function in a box; ``v`` is its minimum
    if no step down the gradient stays in the box.
    """
    slack = np.maximum(problem.rows_lower - problem.rows @ v, 0.0)
    gradient = problem.H @ v + problem.g - problem.rows.T @ (slack / problem.softness())
    active = slack > 0.0
    curvature = problem.H + problem.rows[active].T @ (problem.rows[active] / problem.softness()[active, None])
    step = gradient / np.linalg.norm(curvature, 2)
    return float(np.abs(v - np.clip(v - step, problem.lower, problem.upper)).max())


def _solved(solver: Solver, problem: QpProblem) -> np.ndarray:
    solution = solver.solve(problem)
    assert solution.v is not None
    assert solution.v.shape == (NV,)
    assert np.isfinite(solution.v).all()
    assert solution.solve_time >= 0.0
    return solution.v


CASES = {"without rows": (0, False), "with 3 rows": (3, False), "with 20 rows": (20, False), "torn": (4, True)}


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(("rows", "conflicting"), CASES.values(), ids=CASES.keys())
def test_every_route_finds_the_same_minimum(route: str, rows: int, conflicting: bool) -> None:
    random, solver, reference = np.random.default_rng(28), ROUTES[route](), ROUTES["daqp through qpsolvers"]()
    for _ in range(10):
        problem = _problem(random, rows, conflicting)
        expected = _solved(reference, problem)
        assert _unmet_conditions(problem, expected) < 1e-9
        # qpsolvers leaves OSQP at its own coarse tolerance; the safety filter clamps what that leaves of the box.
        tolerance = 5e-3 if route == "osqp through qpsolvers" else 1e-4
        np.testing.assert_allclose(_solved(solver, problem), expected, rtol=0, atol=tolerance)


def test_the_number_of_rows_may_rise_and_fall_from_tick_to_tick() -> None:
    random, solver, reference = np.random.default_rng(30), ROUTES["daqp"](), ROUTES["daqp through qpsolvers"]()
    for rows in (0, 5, 0, 16, 17, 3, 60, 1, 60, 0):
        problem = _problem(random, rows)
        np.testing.assert_allclose(_solved(solver, problem), _solved(reference, problem), rtol=0, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3], ids="cost times {:g}".format)
def test_a_row_alone_gives_way_by_the_same_part_however_strong_the_cost(scale: float) -> None:
    row = np.zeros((1, NV))
    row[0, :2] = 0.6, 0.8
    wide = np.full(NV, 10.0)
    problem = QpProblem(scale * np.eye(NV), np.zeros(NV), -wide, wide, row, np.ones(1))
    v = _solved(ROUTES["daqp"](), problem)
    assert _violation(problem, v) == pytest.approx(1e-5, rel=0.1)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("what", ["g", "H", "rows"])
def test_numbers_that_are_not_finite_raise_nothing_and_leave_no_trace(route: str, what: str) -> None:
    problem, solver = _problem(np.random.default_rng(32), 3), ROUTES[route]()
    before = _solved(solver, problem)
    broken = {name: getattr(problem, name).copy() for name in ("H", "g", "lower", "upper", "rows", "rows_lower")}
    broken[what].flat[0] = np.nan
    solution = solver.solve(QpProblem(**broken))
    assert solution.v is None or solution.v.shape == (NV,)
    np.testing.assert_allclose(_solved(solver, problem), before, atol=5e-3)


def test_an_unknown_solver_is_answered_with_what_is_installed() -> None:
    with pytest.raises(ConfigError, match=r"control\.solver = 'simplex': not installed") as error:
        make_solver("simplex", NV, None)
    for name in ("daqp", "osqp", *qpsolvers.available_solvers):
        assert name in str(error.value)
